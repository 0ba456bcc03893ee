"""What the pages name is there: files, scripts, configs and options."""

import importlib
import pathlib
import re

import pytest
from ml_collections import ConfigDict

ROOT = pathlib.Path(__file__).parents[1]
PAGES = (
    *("README.md", "experiments/README.md", "experiments/results/README.md"),
    *("experiments/results/POLICIES.md", "experiments/results/PAPER.md"),
    *("experiments/results/FIELDS.md", "experiments/results/TRIES.md"),
)
WITH_COMMANDS = ("experiments/README.md", *PAGES[2:5])
COMMAND = re.compile(r"python -m experiments\.\w+(?: |\\\n *)[^`\n]*(?:\\\n[^`\n]*)*")


def text_of(page):
    return (ROOT / page).read_text(encoding="utf-8")


def commands_of(page):
    """Commands that name a config, without the line breaks in them."""
    found = [match.replace("\\\n", " ") for match in COMMAND.findall(text_of(page))]
    return [command for command in found if re.search(r"--config=\S+\.py", command)]


@pytest.mark.parametrize("page", PAGES)
def test_links_and_pictures_lead_somewhere(page):
    folder = (ROOT / page).parent
    links = re.findall(r"\]\(([^)#\s]*)(?:#[^)]*)?\)", text_of(page))
    local = [link for link in links if link and not link.startswith("http")]
    assert [link for link in local if not (folder / link).exists()] == []


@pytest.mark.parametrize("page", PAGES)
def test_commands_name_scripts_that_there_are(page):
    names = set(re.findall(r"python -m (experiments\.\w+)", text_of(page)))
    paths = [ROOT / f"{name.replace('.', '/')}.py" for name in names]
    assert [path.name for path in paths if not path.exists()] == []


@pytest.mark.parametrize("page", WITH_COMMANDS)
def test_commands_set_options_that_there_are(page):
    commands = commands_of(page)
    assert len(commands) > 3
    for command in commands:
        file, size = re.search(r"--config=(\S+?\.py):?(\w*)", command).groups("")
        module = importlib.import_module(file.removesuffix(".py").replace("/", "."))
        config = module.get_config(*filter(None, [size]))
        named = re.findall(r"--config\.([\w.]+)=", command)
        named += re.findall(
            r"config\.([\w.]+)", " ".join(re.findall(r"--(?:axis|change)=([^=\s]+)", command))
        )
        for name in named:
            value = config
            for key in name.split("."):
                assert isinstance(value, ConfigDict) and key in value, (
                    f"{command}: no option {name}"
                )
                value = value[key]
