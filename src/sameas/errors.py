"""The error for unusable input, and messages that name the arguments of a remedy.

The library knows arguments, only the command line knows options: a :class:`Message` keeps the arguments that it names,
so that a command can replace them by its options. Texts from a file are made printable, quotations of it short.
"""

from __future__ import annotations

import re
import string
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

#: Greatest length of a quotation from a file, and of a whole message (about ten lines of a terminal), in characters.
LONGEST_QUOTE, LONGEST_MESSAGE = 80, 1000
# A quoted text, or a word that is no path: names of files are not cut, and apostrophes are no quotes.
_MORE = f"{{{LONGEST_QUOTE + 1},}}"
_LONG = re.compile(rf"""(?<!\w)(['"])(?:(?!\1).){_MORE}\1(?!\w)|(?<!\S)(?!['"])[^\s/\\]{_MORE}(?!\S)""")


def printable(text: str) -> str:
    """The text in one line, with control characters and invisible ones escaped, so that it cannot affect a terminal.

    >>> print(printable("red" + chr(27) + "[31m" + chr(10) + "next"))
    red\\x1b[31m next
    """
    if text.isprintable():
        return text
    return "".join(map(_escaped, text))


def blanked(text: str) -> str:
    """The text with blanks for what ends a line, controls a terminal, or XML cannot hold."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def _escaped(character: str) -> str:
    if character in "\n\r\t\v\f":
        return " "
    controls = unicodedata.category(character)[0] == "C" or character in "\u2028\u2029"
    return character.encode("unicode_escape").decode("ascii") if controls else character


def _short(text: str) -> str:
    """The printable text, with quotations cut at ``LONGEST_QUOTE`` characters and the whole at ``LONGEST_MESSAGE``."""
    text = _LONG.sub(_cut, printable(text[: 10 * LONGEST_MESSAGE]))
    return text if len(text) <= LONGEST_MESSAGE else text[:LONGEST_MESSAGE] + " …"


def _cut(match: re.Match[str]) -> str:
    quote = match[1] or ""
    return quote + match[0].removeprefix(quote)[:LONGEST_QUOTE] + "…" + quote


@dataclass(frozen=True)
class Argument:
    """An argument named in a message, and its value: literal texts in quotes, placeholders in capitals.

    keys : of an argument that is a mapping, each with the value.

    >>> str(Argument("sigma")), str(Argument("sigma", "ARCSEC")), str(Argument("offset", "'find'"))
    ('sigma', 'sigma=ARCSEC', "offset='find'")
    >>> str(Argument("columns", "NAME", ("lat_deg", "lon_deg")))
    "columns={'lat_deg': NAME, 'lon_deg': NAME}"
    """

    name: str
    value: str = ""
    keys: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.keys:
            return f"{self.name}={{{', '.join(f'{key!r}: {self.value}' for key in self.keys)}}}"
        return f"{self.name}={self.value}" if self.value else self.name

    @property
    def table(self) -> str:
        """The argument as a key of a TOML file."""
        if not self.keys:
            return str(self)
        entries = ", ".join(f'{key} = "{self.value}"' for key in self.keys)
        return f"{self.name} = {{ {entries} }}"


class Message(str):
    """A text for people that names arguments as in Python; :meth:`with_options` names options instead.

    >>> message = Message("catalogue: no errors; give ", Argument("sigma", "ARCSEC"))
    >>> message
    'catalogue: no errors; give sigma=ARCSEC'
    >>> message.with_options(lambda argument: f"--{argument.name}1 {argument.value}")
    'catalogue: no errors; give --sigma1 ARCSEC'
    """

    parts: tuple[str | Argument, ...]

    def __new__(cls, *parts: str | Argument) -> Message:
        message = super().__new__(cls, "".join(map(str, parts)))
        message.parts = tuple(one for part in parts for one in (part.parts if isinstance(part, Message) else (part,)))
        return message

    def __reduce__(self) -> tuple[type[Message], tuple[str | Argument, ...]]:
        return Message, self.parts

    @property
    def arguments(self) -> tuple[Argument, ...]:
        """The arguments named in the message."""
        return tuple(part for part in self.parts if isinstance(part, Argument))

    def with_options(self, option: Callable[[Argument], str]) -> str:
        """The text for the command line; ``option`` gives the option for an argument."""
        return "".join(option(part) if isinstance(part, Argument) else part for part in self.parts)


def naming(template: str) -> Message:
    """The message from a template with arguments in braces, each optionally with a value after a colon.

    >>> naming("give {sigma:ARCSEC} or {ellipse:'A,B,ANGLE'}")
    "give sigma=ARCSEC or ellipse='A,B,ANGLE'"
    """
    parts: list[str | Argument] = []
    for text, name, value, _ in string.Formatter().parse(template):
        parts += [text] if name is None else [text, Argument(name, value or "")]
    return Message(*parts)


def _shortened(text: str) -> str:
    if isinstance(text, Message):
        return Message(*(part if isinstance(part, Argument) else _short(part) for part in text.parts))
    return _short(text)


class InputError(ValueError):
    """Unusable input. The text is printable and of limited length, whatever the input contains.

    message : what is wrong and where: the source, the first offending row or column.
    remedy : what to do, as an argument; the command line names its option. source : the source concerned.

    >>> raise InputError("cat: its epoch is not known", naming("give {epoch:YEAR}"))
    Traceback (most recent call last):
    sameas.errors.InputError: cat: its epoch is not known; give epoch=YEAR
    """

    def __init__(self, message: str, remedy: str = "", *, source: str = "") -> None:
        message, remedy = (_shortened(text) for text in (message, remedy))
        super().__init__(message, remedy)
        self.message, self.remedy, self.source = message, remedy, source

    def __str__(self) -> str:
        return str(self.words)

    @classmethod
    def together(cls, errors: Sequence[InputError]) -> InputError:
        """Several errors in one, so that everything missing is reported at once."""
        if len(errors) == 1:
            return errors[0]
        words: list[str] = []
        for error in errors:
            if words:
                words.append(" Also: " if str(words[-1]).endswith("?") else ". Also: ")
            words.append(error.words)
        return cls(Message(*words), source=errors[0].source)

    @property
    def words(self) -> Message:
        """Message and remedy in one sentence."""
        return Message(self.message, "; ", self.remedy) if self.remedy else Message(self.message)


class UndatedTimes(InputError):
    """A file has the time of day only, and neither the file nor the user states the date."""


class MissingPackage(InputError):
    """An optional package is missing."""


@contextmanager
def optional(needs: str, extra: str, otherwise: str = "") -> Iterator[None]:
    """Around the import of optional packages; a missing one becomes a :class:`MissingPackage` with its install line.

    needs : what needs which packages. extra : of this distribution, which installs them. otherwise : what else helps.

    >>> with optional("plots need matplotlib", "plots"):
    ...     import no_such_package
    Traceback (most recent call last):
    sameas.errors.MissingPackage: plots need matplotlib: pip install 'sameas[plots]'
    """
    try:
        yield
    except ImportError as error:
        raise MissingPackage(f"{needs}: pip install 'sameas[{extra}]'", otherwise) from error


@contextmanager
def reading(where: str, failed: str = "cannot be read") -> Iterator[None]:
    """Within the block, unexpected errors of a reader become an ``InputError``; ``--debug`` shows their origin.

    where : the file, and the line or row if known. failed : what failed, in words.

    >>> with reading("cat.fits", "cannot be read as FITS"):
    ...     int("x")
    Traceback (most recent call last):
    sameas.errors.InputError: cat.fits: cannot be read as FITS: invalid literal for int() with base 10: 'x'
    """
    try:
        yield
    except (InputError, MemoryError, ImportError):
        raise
    except Exception as error:
        raise InputError(f"{where}: {failed}: {first_line(error)}") from error


def first_line(error: BaseException) -> str:
    """The first line of a library's message; the name of its error if there is no message, or only a key."""
    lines = str(error).strip().splitlines()
    kind = type(error).__name__
    if not lines:
        return kind
    return f"{kind}: {lines[0]}" if isinstance(error, KeyError | IndexError) else lines[0].rstrip(".")
