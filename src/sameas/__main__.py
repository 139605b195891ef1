"""``python -m sameas``: the command."""

from sameas.cli import process

if __name__ == "__main__":
    process()
