"""``python -m monstertruckd``."""

from monstertruckd.tools.cli.main import main

if __name__ == "__main__":
    main()
