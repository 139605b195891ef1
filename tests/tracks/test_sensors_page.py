"""The documentation of sensors lists every default of every kind, and every part and field of a description."""

from dataclasses import fields
from pathlib import Path

from sameas.tracks import KINDS
from sameas.tracks.source import _PARTS

PAGE = (Path(__file__).parents[2] / "docs" / "sensors.md").read_text(encoding="utf-8")


def kinds_table():
    """Defaults in rows, kinds in columns, as on the page."""
    kinds = [name for name, kind in KINDS.items() if kind.defaults]
    names = list(dict.fromkeys(name for part in _PARTS for kind in kinds for name in KINDS[kind].defaults
                               if name.startswith(f"{part}.")))  # fmt: skip
    lines = ["| | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
    for name in names:
        values = [KINDS[kind].defaults.get(name) for kind in kinds]
        lines.append(f"| `{name}` | " + " | ".join("" if v is None else f"{v[0]:g}" for v in values) + " |")
    return "\n".join(lines)


def test_the_defaults_of_all_kinds_are_on_the_page():
    assert kinds_table() in PAGE, f"put this into docs/sensors.md:\n{kinds_table()}"


def test_every_part_and_field_of_a_description_is_on_the_page():
    rows = {line.split("`")[1]: line for line in PAGE.splitlines() if line.startswith("| `")}
    for part, made in _PARTS.items():
        for field in fields(made):
            assert f"`{field.name}`" in rows[part], f"{part}.{field.name} is not on the page"
