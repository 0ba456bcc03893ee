"""Fills a page's template and writes it."""

from __future__ import annotations

import os
import pathlib

import jinja2

from experiments.files import write_atomic

SHARED = pathlib.Path(__file__).parent  # base.html and table.html


def write_template(path: str | os.PathLike, folder: str | os.PathLike, **content) -> None:
    """Writes `template.html` of `folder`, filled.

    Args:
      path: where to.
      folder: that of the template, which may extend the shared `base.html`.
      **content: every name that the template uses; text is escaped, `Markup` is not.

    Raises:
      jinja2.UndefinedError: the template uses a name that `content` lacks.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([folder, SHARED]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = environment.get_template("template.html").render(**content)
    write_atomic(path, lambda file: file.write(text.encode()))
