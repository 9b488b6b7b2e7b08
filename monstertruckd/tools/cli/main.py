"""The ``monstertruckd`` command with all its command groups, as tests and shells' completion need it."""

from monstertruckd.tools.cli.entry import COMMANDS, mounted

app = mounted(COMMANDS)


def main() -> None:
    """Run the command line."""
    app()


if __name__ == "__main__":
    main()
