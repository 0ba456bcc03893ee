"""A page: one template, filled and written whole; it needs no other file and no network."""

import os
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import jinja2
from markupsafe import Markup

from experiments.files import write_atomic
from experiments.reporting.tables import Table

FOLDER = pathlib.Path(__file__).parent  # of the templates that pages share


class Section(NamedTuple):
    """One part of a page, shown in this order."""

    title: str
    table: Table | None = None
    note: str = ""
    plots: Sequence[Markup] = ()  # from `plots.to_svg`


def write_page(path: str | os.PathLike, *, title: str, made: dict, sections: list[Section]) -> None:
    """Writes a page of sections about a result file, whose making it shows too."""
    write_template(path, FOLDER / "sections.html", title=title, made=made, sections=sections)


def write_template(path: str | os.PathLike, template: pathlib.Path, **content) -> None:
    """Writes a template, filled; its texts are escaped, `Markup` is not.

    Args:
      path: where to.
      template: its file, or the folder of `template.html`; it may extend the shared `base.html`.
      **content: every name that the template uses.

    Raises:
      jinja2.UndefinedError: the template uses a name that `content` lacks.
    """
    template = template / "template.html" if template.is_dir() else template
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, FOLDER]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = environment.get_template(template.name).render(**content)
    write_atomic(path, lambda file: file.write(text.encode()))
