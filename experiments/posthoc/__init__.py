"""What can be done with a finished run: scripts share how it is loaded and how files are drawn."""
