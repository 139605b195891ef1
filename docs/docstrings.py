"""For the reference: our docstrings as its generator (griffe, with its NumPy style) reads them.

Ours say ``name : what it is``, because types stand in the signature; NumPy's style has the type there. So the meaning
goes to a line of its own. Paragraphs below a section's items go before the sections, references such as
``:class:`Records``` become code, examples outside their section are fenced, and lists get the empty line in front that
Markdown needs.
"""

import re

import griffe

HEADING = re.compile(r"^(\w[\w ]*)\n-+$\n?", re.MULTILINE)
ITEM = re.compile(r"(?P<names>[\w*][\w*., ]*?) : (?P<meaning>\S.*)")


def as_markdown(text: str) -> str:
    prose, *sections = HEADING.split(re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text))
    below = []
    for title, body in zip(sections[::2], sections[1::2], strict=True):
        if title == "Returns":
            prose += f"\n\nReturns: {body}"
        elif title in ("Parameters", "Attributes", "Raises"):
            items, rest = parted(body)
            prose += f"\n\n{rest}"
            below += [title, "-" * len(title), items, ""]
        elif title == "Example":
            below += ["Examples", "--------", body]
        else:
            below += [title, "-" * len(title), body]
    return "\n".join([with_fences(prose), "", *below])


def parted(body: str) -> tuple[str, str]:
    """A section's items, each meaning below its names; the paragraphs that are not items."""
    items, rest, among = [], [], True
    for line in body.splitlines():
        item = ITEM.fullmatch(line)
        if line.strip() and not line.startswith(" "):
            among = item is not None
        if item:
            items += [item["names"], "    " + item["meaning"]]
        else:
            (items if among else rest).append(line)
    return "\n".join(items), "\n".join(rest)


def with_fences(prose: str) -> str:
    lines, before, fenced = [], "", False
    for line in [*prose.splitlines(), ""]:
        item = ITEM.fullmatch(line)
        if fenced and not line.strip():
            lines += ["```", ""]
            fenced = False
        elif line.startswith(">>>") and not fenced:
            lines += ["", "```pycon", line]
            fenced = True
        elif item and not fenced:
            lines += ["", f"- `{item['names']}`: {item['meaning']}"]
        elif line.startswith("- ") and before.strip() and not before.startswith(("- ", "  ")):
            lines += ["", line]
        else:
            lines.append(line)
        before = line
    return "\n".join(lines)


def described(text: str) -> list[str]:
    """The names in a docstring's section of attributes."""
    _, *sections = HEADING.split(text)
    bodies = [body for title, body in zip(sections[::2], sections[1::2], strict=True) if title == "Attributes"]
    items = [item["names"] for body in bodies for line in body.splitlines() if (item := ITEM.fullmatch(line))]
    return [name.strip() for names in items for name in names.split(",")]


class Docstrings(griffe.Extension):
    """Rewrites every docstring of the package, and warns of attributes that are described and not there."""

    def on_package(self, *, pkg: griffe.Module, **_: object) -> None:
        rest: list[griffe.Object] = [pkg]
        while rest:
            one = rest.pop()
            rest += [member for member in one.members.values() if not member.is_alias]
            if one.docstring is None:
                continue
            if one.is_class:
                for name in described(one.docstring.value):
                    if name not in one.all_members:
                        griffe.logger.warning(f"{one.path}: its docstring describes {name}, which it does not have")
            one.docstring.value = as_markdown(one.docstring.value)
