"""Messages: arguments become options; text quoted from files is printable and short."""

import pickle

import pytest

from sameas.errors import LONGEST_MESSAGE, Argument, InputError, Message, naming, printable

HOSTILE = {
    "colour of a terminal": "\x1b[31mred\x1b[0m",
    "title of a terminal": "\x1b]0;owned\x07",
    "bell and backspaces": "\a\b\b\b\x00",
    "eight-bit control": "\x9b31m",
    "right to left": "\u202egpj.exe",
    "nothing to see": "a\u200bb\ufeffc",
    "line separators": "a\u2028b\u2029c",
    "half a character": "\ud800",
}


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)
def test_messages_contain_no_terminal_control_characters(text):
    message = str(InputError(f"cat: the name {text} is not known", f"rename {text}"))
    assert message.isprintable() and message.isascii()
    assert message.startswith("cat: the name ") and "; rename " in message


def test_letters_symbols_and_spaces_are_kept():
    for text in ("Δδ ≤ 3σ, 10\u202f000 “rows” \u00a0 日本 🛰", "C:\\data\\a.csv", "it's '42'", "\\x1b"):
        assert printable(text) == text and str(InputError(text)) == text


def test_a_message_is_one_line():
    assert str(InputError("library says:\r\n\tno\n", "try\nagain")) == "library says:   no ; try again"


@pytest.mark.parametrize("quote", ["'", '"', ""])
def test_long_text_from_files_is_truncated(quote):
    given = f"{quote}{'x' * 1000}{quote}"
    kept = f"{quote}{'x' * 80}…{quote}"
    assert str(InputError(f"cat: {given} is no number", "mend it")) == f"cat: {kept} is no number; mend it"
    short = f"{quote}{'x' * 80}{quote}"
    assert short in str(InputError(f"cat: {short} is no number"))


def test_long_quoted_text_with_spaces_is_truncated():
    assert str(InputError(f"line 3: {'a b ' * 200!r} is no record")) == f"line 3: '{'a b ' * 20}…' is no record"


def test_apostrophes_are_no_quotation_marks():
    words = "the header's solution is not that of the frame, which lies elsewhere " * 2 + "by the sensors' own plots'"
    assert str(InputError(words)) == words


def test_file_names_are_not_truncated():
    path = "/".join(["", *["folder with a long name"] * 8, "x" * 100 + ".csv"])
    assert path in str(InputError(f"{path}: no such file"))


def test_the_length_of_a_message_is_bounded():
    columns = ", ".join(f"column_{k}" for k in range(5000))
    message = str(InputError(f"cat: no column ra among {columns}", naming("give {ra:NAME}")))
    assert len(message) < LONGEST_MESSAGE + 40 and message.endswith(" …; give ra=NAME")


def test_arguments_of_a_remedy_stay_arguments():
    error = InputError("cat: \x1b", Message("give ", Argument("sigma", "ARCSEC"), " of \x1b"))
    assert error.words.with_options(lambda argument: f"--{argument.name}") == "cat: \\x1b; give --sigma of \\x1b"
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error) and again.words.arguments == error.words.arguments
