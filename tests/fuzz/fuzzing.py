"""Fuzzes the readers: small files of all formats, changed at random, give an answer or one line that refuses them.

``scripts/fuzz --all --inputs 100000`` runs this for hours, tests/fuzz/test_fuzz.py for seconds. Inputs are read in one
child process that lives long, each within seconds of the processor and within memory beyond what the child had before;
a child that dies or hangs is a fault of the input it was at, and another goes on behind it. Input k of a format is the
same in every run with the same seed. With ``--results FOLDER`` the findings on a format are kept in a file, with the
code that read them: a run that was stopped goes on where it stood, and one that is complete is printed. What other code
has read (another module that reading this format loads, another library, other inputs) counts for nothing and is read
anew, unless ``--older`` is given: then it is printed, with its day. ``--again`` reads the inputs that ended in a fault
once more.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import math
import os
import random
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
SOURCE = HERE.parents[1] / "src" / "sameas"
#: Libraries used for reading, if installed.
LIBRARIES = ("numpy", "numba", "astropy", "pyarrow", "PyYAML", "pyais", "pyModeS", "rs1090", "pymap3d")
#: Limits per input: CPU seconds, and bytes beyond the child's memory at start.
SECONDS, BYTES = 5.0, 1 << 30
#: CPU seconds after which the child is killed if Python does not regain control (a loop in C).
LAST_SECONDS = 12
#: Seconds without output after which a child counts as hanging.
SILENT_SECONDS = 600.0
#: Inputs per child; then a new one takes over, so that memory leaks of libraries do not add up.
INPUTS_OF_A_CHILD = 20_000
#: Findings are saved after this number of inputs.
INPUTS_OF_A_PART = 2000

NUMBERS = (
    b"0",
    b"-1",
    b"1",
    b"nan",
    b"inf",
    b"-inf",
    b"1e308",
    b"1e999",
    b"-0.0",
    b"999999999999",
    b"2147483648",
    b"91",
    b"361",
    b"9" * 25,
    b"18446744073709551616",
    b"1e-320",
    b"",
    b"0x10",
    b"1_0",
    b"1d5",
    "½".encode(),
    b"T",
)
TEXTS = (
    b"\0", b"\x1b[31m", b"<script>alert(1)</script>", b'"', b"'", b"\xff\xfe", "\u2028".encode(), "\ufeff".encode(),
    b"\n", b"\r", b",", b";", b"|", b"=cmd()", b"../../x", b"{", b"[", b"[" * 5000, b"A" * 3000, b"%s%n", b"--",
    b"null", b"true", b"&lt;", b"<!ENTITY a 'b'>", b"&a;", b"END".ljust(80), b"\t", b"  ",
)  # fmt: skip


def changed(content: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """The content after a few random mutations, mostly one or two."""
    out = bytearray(content)
    for _ in range(1 + min(int(rng.expovariate(0.9)), 12)):
        rng.choice(CHANGES)(out, rng, others)
    return bytes(out)


def _place(out: bytearray, rng: random.Random) -> int:
    return rng.randrange(len(out) + 1)


def _bits(out: bytearray, rng: random.Random, others: Sequence[bytes]) -> None:
    if out:
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)


def _byte(out: bytearray, rng: random.Random, others: Sequence[bytes]) -> None:
    if out:
        at = rng.randrange(len(out))
        size = rng.choice((1, 1, 2, 4, 8))
        out[at : at + size] = rng.choice((b"\0", b"\xff", b"\x7f", b"\x80", rng.randbytes(1))) * len(
            out[at : at + size]
        )


def _cut(out: bytearray, rng: random.Random, others: Sequence[bytes]) -> None:
    del out[_place(out, rng) :]


def _less(out: bytearray, rng: random.Random, others: Sequence[bytes]) -> None:
    at = _place(out, rng)
    del out[at : at + 1 + int(rng.expovariate(0.02))]


def _again(out: bytearray, rng: random.Random, others: Sequence[bytes]) -> None:
    at = _place(out, rng)
    out[at:at] = bytes(out[at : at + 1 + int(rng.expovariate(0.01))]) * rng.choice((1, 1, 2, 30))


def _other(out: bytearray, rng: random.Random, others: Sequence[bytes]) -> None:
    other, at = rng.choice(others), _place(out, rng)
    begin = rng.randrange(len(other) + 1)
    out[at : at + rng.choice((0, 200))] = other[begin : begin + 1 + int(rng.expovariate(0.01))]


def _text(out: bytearray, rng: random.Random, others: Sequence[bytes]) -> None:
    at, text = _place(out, rng), rng.choice(TEXTS)
    out[at : at + rng.choice((0, len(text)))] = text


def _number(out: bytearray, rng: random.Random, others: Sequence[bytes]) -> None:
    """Replace a number by another; in FITS cards of equal length."""
    begin = _place(out, rng)
    digits = [at for at in range(begin, min(begin + 4000, len(out))) if 48 <= out[at] <= 57]
    if digits:
        first = last = digits[0]
        while last < len(out) and out[last] in b"0123456789.eE+-":
            last += 1
        number = rng.choice(NUMBERS)
        if out[:6] == b"SIMPLE":
            number = number[: max(last - first, 12)]
            last = first + len(number)
        out[first:last] = number


def _card(out: bytearray, rng: random.Random, others: Sequence[bytes]) -> None:
    """In FITS change the value of a card; elsewhere delete or duplicate a line."""
    if out[:6] == b"SIMPLE":
        cards = [at for at in range(0, min(len(out), 40000), 80) if out[at + 8 : at + 10] == b"= "]
        if cards:
            at = rng.choice(cards)
            value = rng.choice((*NUMBERS, b"'x'", b"F", b"''", b"'1PB(99999999)'", b"'99999999D'", b"'0A'", b"(1,2)"))[
                :60
            ]
            out[at + 10 : at + 80] = value.rjust(rng.choice((20, 1))).ljust(70)[:70]
        return
    lines = bytes(out).split(b"\n")
    at = rng.randrange(len(lines))
    lines[at : at + 1] = rng.choice(([], [lines[at]] * 2, [rng.choice(lines)], [b"".join(lines[at : at + 2])]))
    out[:] = b"\n".join(lines)


CHANGES = (_bits, _bits, _byte, _byte, _cut, _less, _again, _other, _text, _number, _number, _number, _card, _card)


# The child: reads inputs and reports the outcome of each.


class TooLong(BaseException):
    """An input exceeded its CPU time."""


def input_of(name: str, seed: int, number: int, corpus: Any) -> bytes:
    """Input ``number`` of a target: a mutated file of its corpus."""
    from corpus import TARGETS

    rng = random.Random(f"{name}:{seed}:{number}")
    seeds = corpus.seeds(name)
    return TARGETS[name].outside(changed(rng.choice(seeds), rng, seeds))


def outcome(read: Any, path: Path) -> str:
    """Outcome of reading a file: "answered", "refused", or a description of the fault."""
    from sameas.errors import InputError

    ignored: list[Any] = []
    hook, sys.unraisablehook = sys.unraisablehook, ignored.append
    try:
        read(path)
        if ignored:  # a traceback printed by a library that caught the exception
            raise ignored[0].exc_value
    except InputError as error:
        if ignored:
            return f"prints {type(ignored[0].exc_value).__name__}: {str(ignored[0].exc_value)[:150]}"
        message = str(error)
        if not message.isprintable() or len(message) > 2100:
            return f"says {message[:300]!r}"
        return "refused"
    except TooLong:
        return f"took more than {SECONDS:g} s"
    except MemoryError:
        return f"needed more than {BYTES >> 20} MB"
    except BaseException as error:
        import traceback

        at = traceback.extract_tb(error.__traceback__)
        ours = [f for f in at if "sameas" in f.filename] or at
        where = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"
        return f"{type(error).__name__}: {str(error)[:150]} ({where})"
    finally:
        sys.unraisablehook = hook
    return "answered"


def _child() -> None:
    """Reads lines "format seed first last" and answers each input with "number seconds outcome"."""
    import resource
    import warnings

    sys.path.insert(0, str(HERE))
    from corpus import TARGETS, Corpus

    warnings.simplefilter("ignore")
    corpus, warm = Corpus(), set()

    def too_long(number: int, frame: Any) -> None:
        raise TooLong

    signal.signal(signal.SIGPROF, too_long)
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as folder:
        for line in sys.stdin:
            if line == "modules\n":
                sys.stdout.write("\t".join(_modules()) + "\n")
                sys.stdout.flush()
                continue
            name, seed, first, last = line.rstrip("\n").split("\t")
            path = Path(folder) / f"input{TARGETS[name].ending}"
            if name not in warm:
                warm.add(name)
                for limit in (resource.RLIMIT_AS, resource.RLIMIT_CPU):  # that of the last format is for its inputs
                    resource.setrlimit(limit, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
                for content in corpus.seeds(name):
                    path.write_bytes(TARGETS[name].outside(content))
                    outcome(TARGETS[name].read, path)  # of some tables only some questions are answered
                if os.path.exists("/proc/self/statm"):
                    pages = int(Path("/proc/self/statm").read_text().split()[0])
                    most = pages * resource.getpagesize() + BYTES
                    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
            for number in range(int(first), int(last)):
                path.unlink(missing_ok=True)  # a table of the last input may still be mapped, as of a file that is kept
                path.write_bytes(input_of(name, int(seed), number, corpus))
                for again in (False, True):
                    began = time.process_time()
                    last_s = math.ceil(began) + LAST_SECONDS
                    resource.setrlimit(resource.RLIMIT_CPU, (last_s, resource.RLIM_INFINITY))
                    signal.setitimer(signal.ITIMER_PROF, SECONDS)
                    try:
                        what = outcome(TARGETS[name].read, path)
                    except TooLong:
                        what = f"took more than {SECONDS:g} s"
                    finally:
                        signal.setitimer(signal.ITIMER_PROF, 0.0)
                    seconds = time.process_time() - began
                    if again or not what.startswith("took"):  # the first time a kernel may have been compiled
                        break
                reason = " ".join(what.split())
                sys.stdout.write(f"{number}\t{seconds:.4f}\t{reason}\n")
                sys.stdout.flush()


def _modules() -> list[str]:
    """The modules of sameas that this process has loaded, as paths below its folder."""
    files = [getattr(module, "__file__", None) for name, module in sys.modules.items() if name.startswith("sameas")]
    return sorted({Path(file).relative_to(SOURCE).as_posix() for file in files if file})


# The parent: distributes work to a child, and replaces it when it dies or hangs.


@dataclass
class Findings:
    """Outcomes of the inputs of one format. faults : {description: input numbers}."""

    tried: int = 0
    answered: int = 0
    refused: int = 0
    slowest_s: float = 0.0
    faults: dict[str, list[int]] = field(default_factory=dict)

    def add(self, number: int, seconds: float, what: str) -> None:
        self.tried += 1
        self.slowest_s = max(self.slowest_s, seconds)
        if what == "answered":
            self.answered += 1
        elif what == "refused":
            self.refused += 1
        else:
            self.faults.setdefault(what, []).append(number)

    def include(self, more: Findings) -> None:
        """Add the findings on other inputs."""
        self.tried, self.answered = self.tried + more.tried, self.answered + more.answered
        self.refused, self.slowest_s = self.refused + more.refused, max(self.slowest_s, more.slowest_s)
        for what, numbers in more.faults.items():
            self.faults.setdefault(what, []).extend(numbers)


@dataclass(frozen=True)
class Code:
    """Identification of the code that reads the inputs.

    modules : a digest of each loaded module of sameas, without its comments and docstrings. libraries : their versions.
    inputs : a digest of the first fifty inputs, which changes with the corpus and with how inputs are changed.
    """

    modules: dict[str, str]
    libraries: dict[str, str]
    inputs: str

    @classmethod
    def of(cls, modules: Sequence[str], name: str, seed: int, corpus: Any) -> Code:
        """The current code."""
        digest = hashlib.sha256()
        for number in range(50):
            digest.update(input_of(name, seed, number, corpus))
        versions = {"python": sys.version.split()[0]}
        for library in LIBRARIES:
            try:
                versions[library] = version(library)
            except PackageNotFoundError:
                continue
        paths = {module: SOURCE / module for module in modules}
        return cls(
            {module: _digest(_meaning(path)) if path.is_file() else "gone" for module, path in paths.items()},
            versions, digest.hexdigest()[:16],
        )  # fmt: skip

    def stands(self, later: Code) -> bool:
        """Whether ``later``, with possibly more modules loaded, is the same code."""
        return self.modules.items() <= later.modules.items() and (self.libraries, self.inputs) == (
            later.libraries,
            later.inputs,
        )


def _meaning(path: Path) -> bytes:
    """Syntax tree of a module without comments and docstrings, so that rewording does not change it."""
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            node.body = [one for one in node.body if not _is_text(one)]
    return ast.dump(tree).encode()


def _is_text(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


@dataclass
class Kept:
    """The findings on the inputs of one format up to ``upto``, in a file. code : what these were read by; None of those
    that were not told. day : when the last of them was read. older : what was read by other code, if more."""

    path: Path
    name: str
    seed: int
    upto: int = 0
    findings: Findings = field(default_factory=Findings)
    code: Code | None = None
    day: str = ""
    older: dict[str, Any] | None = None

    @classmethod
    def of(cls, folder: Path, name: str, seed: int, corpus: Any) -> Kept:
        """The findings of an earlier run with this seed and code, or empty ones."""
        path = folder / f"{name.replace(' ', '-')}-{seed}.json"
        if not path.exists():
            return cls(path, name, seed)
        saved = json.loads(path.read_text(encoding="utf-8"))
        older, code = saved.pop("older", None), saved.get("code")
        if code is not None and asdict(Code.of(list(code["modules"]), name, seed, corpus)) == code:
            return cls(
                path, name, seed, saved["upto"], Findings(**saved["findings"]), Code(**code), saved["day"], older
            )
        saved.setdefault("day", datetime.fromtimestamp(path.stat().st_mtime, UTC).date().isoformat())
        return cls(path, name, seed, older=max(saved, older or saved, key=lambda one: int(one["upto"])))

    def save(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.day = datetime.now(UTC).date().isoformat()
        code = None if self.code is None else asdict(self.code)
        saved = {"upto": self.upto, "findings": asdict(self.findings), "code": code, "day": self.day}
        if self.older is not None:
            saved["older"] = self.older
        draft = self.path.with_suffix(".draft")
        draft.write_text(json.dumps(saved, indent=1) + "\n", "utf-8")
        draft.replace(self.path)

    def again(self, fuzzer: Fuzzer) -> None:
        """Read the inputs that ended in a fault again."""
        before, self.findings.faults = self.findings.faults, {}
        for number in sorted(number for numbers in before.values() for number in numbers):
            self.findings.tried -= 1
            self.findings.include(fuzzer.run(self.name, number, number + 1))
        self.save()

    def printed(self, older: bool) -> tuple[Findings, str]:
        """The findings to print, and the code that produced them."""
        if older and self.older is not None and int(self.older["upto"]) > self.upto:
            return Findings(**self.older["findings"]), self.older["day"]
        return self.findings, "this code"


class Fuzzer:
    """A child process, replaced when it died, hung or reached its number of inputs."""

    def __init__(self, seed: int = 0) -> None:
        self.seed, self.read = seed, 0
        self.process: subprocess.Popen[bytes] | None = None
        self.rest = b""

    def run(self, name: str, first: int, last: int) -> Findings:
        """The findings on inputs first to last − 1 of a format."""
        found = Findings()
        at, again = first, -1
        while at < last:
            process = self._child()
            end = min(last, at + INPUTS_OF_A_CHILD)
            assert process.stdin is not None
            process.stdin.write(f"{name}\t{self.seed}\t{at}\t{end}\n".encode())
            process.stdin.flush()
            for line in self._lines(process):
                number, seconds, what = line.split("\t", 2)
                found.add(int(number), float(seconds), what)
                at, self.read = int(number) + 1, self.read + 1
                if at == end:
                    break
            if at < end:
                silent = process.poll() is None
                process.kill()
                code = process.wait()
                self.process = None
                hung = silent or code == -signal.SIGXCPU
                # The kernel checks the limit by whole ticks: in a child that lives long, on a loaded machine, they
                # run ahead of the clock that the limit is set by. Only a new child that hangs as well is a finding.
                if hung and again != at:
                    again = at
                    continue
                found.add(at, 0.0, "hung" if hung else f"ended the process ({code})")  # -9: killed from outside
                at += 1
        return found

    def modules(self, name: str) -> list[str]:
        """What a child that has read a format has loaded of sameas; a new one reads its first input, where it ended."""
        for _ in range(3):
            process = self._child()
            assert process.stdin is not None
            try:
                process.stdin.write(b"modules\n")
                process.stdin.flush()
                return next(self._lines(process)).split("\t")
            except (StopIteration, BrokenPipeError):
                process.kill()
                process.wait()
                self.process = None
                self.run(name, 0, 1)
        raise RuntimeError(f"{name}: children end when they are asked what they have loaded")

    def _child(self) -> subprocess.Popen[bytes]:
        if self.process is not None and self.read >= INPUTS_OF_A_CHILD:
            self.close()
        if self.process is None:
            environment = {**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system", "MALLOC_ARENA_MAX": "2",
                           "SAMEAS_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "0",
                           "SOURCE_DATE_EPOCH": "1700000000"}  # fmt: skip
            self.process = subprocess.Popen(
                [sys.executable, __file__, "--child"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, env=environment,
            )  # fmt: skip
            self.read, self.rest = 0, b""
        return self.process

    def _lines(self, process: subprocess.Popen[bytes]) -> Iterator[str]:
        """Lines of the child's output, until it ends or its timeout."""
        assert process.stdout is not None
        while True:
            while b"\n" in self.rest:
                line, _, self.rest = self.rest.partition(b"\n")
                yield line.decode("utf-8", "replace")
            if not select.select([process.stdout], [], [], SILENT_SECONDS)[0]:
                return
            part = os.read(process.stdout.fileno(), 1 << 16)
            if not part:
                process.wait()
                return
            self.rest += part

    def close(self) -> None:
        if self.process is not None:
            assert self.process.stdin is not None and self.process.stdout is not None
            self.process.stdin.close()
            self.process.stdout.close()
            self.process.wait()
            self.process = None


def main() -> int:
    sys.path.insert(0, str(HERE))
    from corpus import TARGETS, Corpus

    parser = argparse.ArgumentParser(prog="scripts/fuzz", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--all", action="store_true", help="every format")
    parser.add_argument("--format", action="append", choices=sorted(TARGETS), default=[], help="one format; repeat it")
    parser.add_argument("--inputs", type=int, default=1000, help="inputs of each format")
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="time for each format, at most")
    parser.add_argument("--keep", type=Path, help="folder for the inputs that end in a fault")
    parser.add_argument("--results", type=Path, help="folder for the findings; a run that was stopped goes on from "
                        "there, and what the same code has read already is not read again")  # fmt: skip
    parser.add_argument("--older", action="store_true", help="with --results: print also what other code has read, "
                        "where that is more, with its day; read nothing")  # fmt: skip
    parser.add_argument("--again", action="store_true", help="first read again what ended in a fault (with --results)")
    given = parser.parse_args()
    names = list(TARGETS) if given.all else given.format
    if not names:
        parser.error("give --all or --format NAME")
    os.environ["SOURCE_DATE_EPOCH"] = "1700000000"  # so that the files that are changed are the same on every day
    heads = f"{'format':16}{'tried':>9}{'answered':>10}{'refused':>9}{'faults':>8}{'slowest s':>11}{'a minute':>10}"
    print(heads + ("  read by" if given.results else ""), flush=True)
    fuzzer, together, corpus = Fuzzer(given.seed), Findings(), Corpus()
    for name in names:
        kept = Kept.of(given.results, name, given.seed, corpus) if given.results else None
        found = kept.findings if kept else Findings()
        if kept:
            fuzzer.close()  # so that a child has loaded what this format needs, and no more
        if kept and given.again:
            kept.again(fuzzer)
        began, at, last = time.monotonic(), max(given.first, kept.upto if kept else 0), given.first + given.inputs
        first = at
        while at < last and time.monotonic() - began < given.seconds and not given.older:
            end = min(at + INPUTS_OF_A_PART, last)
            found.include(fuzzer.run(name, at, end))
            at = end
            if kept:
                loaded = {*fuzzer.modules(name), *(kept.code.modules if kept.code else ())}
                code = Code.of(sorted(loaded), name, given.seed, corpus)
                if kept.code is not None and not kept.code.stands(code):
                    fuzzer.close()
                    parser.error(f"sameas changed while {name} was read; begin again")
                kept.upto, kept.code = at, code
                kept.save()
        shown, by = kept.printed(given.older) if kept else (found, "")
        together.include(shown)
        rate = 60.0 * (at - first) / (time.monotonic() - began)
        print(_row(name, shown) + f"{rate:10.0f}" + (f"  {by}" if by else ""), flush=True)
        for what, numbers in sorted(shown.faults.items(), key=lambda fault: -len(fault[1])):
            print(f"    {len(numbers)} × {what}; inputs {', '.join(map(str, numbers[:5]))}", flush=True)
            if given.keep:
                given.keep.mkdir(parents=True, exist_ok=True)
                path = given.keep / f"{name.replace(' ', '-')}-{numbers[0]}{TARGETS[name].ending}"
                path.write_bytes(input_of(name, given.seed, numbers[0], corpus))
    fuzzer.close()
    print(_row("together", together), flush=True)
    return int(bool(together.faults))


def _row(name: str, found: Findings) -> str:
    faults = sum(map(len, found.faults.values()))
    return f"{name:16}{found.tried:9}{found.answered:10}{found.refused:9}{faults:8}{found.slowest_s:11.2f}"


if __name__ == "__main__":
    if sys.argv[1:] == ["--child"]:
        _child()
    else:
        sys.exit(main())
