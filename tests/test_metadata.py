"""Package metadata is consistent wherever it is repeated."""

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest

import sameas

HOME = Path(__file__).parents[1]
PROJECT = tomllib.loads((HOME / "pyproject.toml").read_text("utf-8"))["project"]


def text_of(name):
    return (HOME / name).read_text("utf-8")


def test_the_version_is_the_same_everywhere():
    assert "version" not in PROJECT and "version" in PROJECT["dynamic"]
    assert re.search(r"^version: (.*)$", text_of("CITATION.cff"), re.MULTILINE)[1] == sameas.__version__
    newest = re.search(r"^## (\S+) – (unreleased|\d{4}-\d\d-\d\d)$", text_of("CHANGELOG.md"), re.MULTILINE)
    assert newest[1] == sameas.__version__
    assert f"Version {sameas.__version__}" in text_of("README.md")


def test_the_citation_agrees_with_the_project_metadata():
    citation = text_of("CITATION.cff")
    assert f"license: {PROJECT['license']}" in citation
    for author in PROJECT["authors"]:
        assert author["name"].lower() in citation.lower()
    assert set(re.findall(r"^  - ([\w-]+(?: [\w-]+)*)$", citation, re.MULTILINE)) <= set(PROJECT["keywords"])


def test_every_version_of_python_that_is_tested_is_classified():
    tested = re.search(r"python: \[(.*)\]", text_of(".github/workflows/ci.yml"))[1]
    versions = [one.rpartition(" ")[2] for one in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", one)]
    assert versions == re.findall(r"3\.\d+", tested)
    assert PROJECT["requires-python"] == f">={versions[0]}"


def test_links_of_the_long_description_are_absolute():
    spec = importlib.util.spec_from_file_location("long_description", HOME / "scripts/long_description.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = module.long_description(text_of("README.md"), "https://forge.example/sameas", "1.2.3")
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    links = re.findall(r"\]\(([^)\s]+)\)", prose)
    assert len(links) > 20 and all(link.startswith(("https://", "#")) for link in links)
    assert "https://forge.example/sameas/blob/v1.2.3/docs/method.md" in links
    assert "<!--" not in text
    picture = module.long_description("![a](b.png) [c](d.md) [e](#f) [g](https://h)", "https://r", "1")
    assert picture == "![a](https://r/raw/v1/b.png) [c](https://r/blob/v1/d.md) [e](#f) [g](https://h)"


@pytest.mark.parametrize("key", ["title", "tags", "authors", "affiliations", "date", "bibliography"])
def test_the_paper_has_the_header_required_by_its_journal(key):
    head = text_of("paper.md").split("---")[1]
    assert re.search(rf"^{key}:", head, re.MULTILINE)


def test_every_row_of_the_papers_tables_was_measured():
    """Rows of the paper's tables are rows of the pages of what was measured."""
    pages = text_of("docs/measured.md") + text_of("docs/measured-targets.md")
    measured = [row.replace("*", "") for row in pages.splitlines()]
    rows = [row for row in text_of("paper.md").splitlines() if row.startswith("| ") and re.search(r"\d", row)]
    assert len(rows) >= 10
    for row in rows:
        assert row in measured, row


def test_all_citations_of_the_paper_are_in_its_bibliography():
    cited = set(re.findall(r"@([\w:]+)", text_of("paper.md").split("---", 2)[2]))
    assert cited == set(re.findall(r"^@\w+\{([\w:]+),", text_of("paper.bib"), re.MULTILINE)) and len(cited) >= 8
    assert len(re.findall(r"\n  doi = ", text_of("paper.bib"))) >= 6


def test_the_paper_has_the_length_required_by_its_journal():
    words = len(re.sub(r"^\|.*$", "", text_of("paper.md").split("---", 2)[2], flags=re.MULTILINE).split())
    assert 250 <= words <= 1750
