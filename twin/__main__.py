"""Entry of the `twin` command: `python -m twin` does the same."""

import sys


def main() -> None:
    """Run the command line; an interrupt while it is still being loaded ends in one line too."""
    try:
        from twin.cli import main as run
    except KeyboardInterrupt:
        print("twin: interrupted", file=sys.stderr)
        sys.exit(1)
    sys.exit(run())


if __name__ == "__main__":
    main()
