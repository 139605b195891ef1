"""The long description of the package: README.md, its links made absolute, without the comments for the tests."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

try:
    from hatchling.metadata.plugin.interface import MetadataHookInterface
except ImportError:  # where nothing is built
    MetadataHookInterface = object


def long_description(text: str, repository: str, version: str) -> str:
    """A page of the repository as a package index shows it: links lead to the files of the version's tag."""
    text = re.sub(r"^<!--.*?-->\n", "", text, flags=re.MULTILINE)
    text = re.sub(r"(!\[[^\]]*\]\()(?!\w+:|#)", rf"\g<1>{repository}/raw/v{version}/", text)
    return re.sub(r"((?<!!)\[[^\]]*\]\()(?!\w+:|#)", rf"\g<1>{repository}/blob/v{version}/", text)


class LongDescription(MetadataHookInterface):
    """What hatchling asks for the field ``readme``."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Fills the field in."""
        home = Path(self.root)
        package = (home / "src/sameas/__init__.py").read_text("utf-8")
        version = re.search(r'^__version__ = "(.*)"$', package, re.MULTILINE)
        text = (home / "README.md").read_text("utf-8")
        repository = metadata["urls"]["Repository"]
        metadata["readme"] = {
            "content-type": "text/markdown",
            "text": long_description(text, repository, version[1] if version else ""),
        }
