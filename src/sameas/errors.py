"""The error of input that cannot be used, and messages that name the arguments of a remedy.

The library knows arguments, only the command line knows options: a :class:`Message` keeps the arguments that it names,
so that a command can name its options in their place.
"""

from __future__ import annotations

import string
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Argument:
    """An argument that a message names, and what to give it; texts in quotes, what the user puts there in capitals.

    >>> str(Argument("sigma")), str(Argument("sigma", "ARCSEC")), str(Argument("offset", "'find'"))
    ('sigma', 'sigma=ARCSEC', "offset='find'")
    """

    name: str
    value: str = ""

    def __str__(self) -> str:
        return f"{self.name}={self.value}" if self.value else self.name


class Message(str):
    """A text for people that names arguments as Python has them; :meth:`with_options` names options instead.

    >>> message = Message("catalogue: no errors; say ", Argument("sigma", "ARCSEC"))
    >>> message
    'catalogue: no errors; say sigma=ARCSEC'
    >>> message.with_options(lambda argument: f"--{argument.name}1 {argument.value}")
    'catalogue: no errors; say --sigma1 ARCSEC'
    """

    parts: tuple[str | Argument, ...]

    def __new__(cls, *parts: str | Argument) -> Message:
        made = super().__new__(cls, "".join(map(str, parts)))
        made.parts = tuple(one for part in parts for one in (part.parts if isinstance(part, Message) else (part,)))
        return made

    def __reduce__(self) -> tuple[type[Message], tuple[str | Argument, ...]]:
        return Message, self.parts

    @property
    def arguments(self) -> tuple[Argument, ...]:
        """The arguments that it names."""
        return tuple(part for part in self.parts if isinstance(part, Argument))

    def with_options(self, option: Callable[[Argument], str]) -> str:
        """The text as the command line has it. option : what the command line has instead of an argument."""
        return "".join(option(part) if isinstance(part, Argument) else part for part in self.parts)


def naming(template: str) -> Message:
    """The message of a template, in which braces hold arguments, with what to give them behind a colon.

    >>> naming("say {sigma:ARCSEC} or {ellipse:'A,B,ANGLE'}")
    "say sigma=ARCSEC or ellipse='A,B,ANGLE'"
    """
    parts: list[str | Argument] = []
    for text, name, value, _ in string.Formatter().parse(template):
        parts += [text] if name is None else [text, Argument(name, value or "")]
    return Message(*parts)


class InputError(ValueError):
    """Input that cannot be used.

    message : what is wrong and where: the source, the first offending row or column.
    remedy : what to do, as an argument; the command line names its option. source : the source that it is about.

    >>> raise InputError("cat: its epoch is not known", naming("say {epoch:YEAR}"))
    Traceback (most recent call last):
    sameas.errors.InputError: cat: its epoch is not known; say epoch=YEAR
    """

    def __init__(self, message: str, remedy: str = "", *, source: str = "") -> None:
        super().__init__(message, remedy)
        self.message, self.remedy, self.source = message, remedy, source

    def __str__(self) -> str:
        return str(self.words)

    @property
    def words(self) -> Message:
        """Message and remedy in one sentence."""
        return Message(self.message, "; ", self.remedy) if self.remedy else Message(self.message)
