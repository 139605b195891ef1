"""``python -m sameas``: the command."""

from sameas.cli import main

if __name__ == "__main__":
    main()
