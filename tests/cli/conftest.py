"""Two small catalogues of one field, and the command in this process."""

import pytest
from fields import field, save
from typer.testing import CliRunner

from sameas.cli.app import app


@pytest.fixture(scope="session")
def field_files(tmp_path_factory):
    """Paths of two FITS files: 120 stars, and 100 of them observed again."""
    where = tmp_path_factory.mktemp("field")
    return save(field(120, 2), where / "first.fits"), save(field(100, 3), where / "second.fits")


@pytest.fixture
def sameas():
    """A function that runs the command in this process and returns stdout, stderr and exit_code."""

    def run(*arguments, exit_code=0):
        result = CliRunner().invoke(app, [str(a) for a in arguments])
        assert result.exit_code == exit_code, result.output
        return result

    return run


@pytest.fixture
def refusal(sameas):
    """A function that returns the refusal of a command: one line on stderr, without its prefix."""

    def run(*arguments):
        result = sameas(*arguments, exit_code=1)
        lines = [line for line in result.stderr.splitlines() if not line.startswith("sameas: compiling")]
        assert len(lines) == 1 and lines[0].startswith("sameas: "), result.stderr
        assert "Traceback" not in result.output
        return lines[0].removeprefix("sameas: ")

    return run
