"""A trained field and its uncertainty as files that other programs read.

Everything here makes arrays or bytes; who calls it writes the files.
"""
