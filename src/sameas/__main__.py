"""``python -m sameas``: the command."""

from sameas.cli import main

main()
