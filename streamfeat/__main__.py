"""`python -m streamfeat` and `streamfeat`: the command line.

Lives here: the call alone, and that an interrupt is heard before anything else is loaded. Not here: commands
(`cli`).
"""

from streamfeat.work import interrupts


def main() -> None:
    """Run the command line."""
    interrupts.start()
    from streamfeat.cli import main as run

    run()


if __name__ == "__main__":
    main()
