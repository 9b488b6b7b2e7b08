"""``python -m monstertruckd``."""

from monstertruckd.cli.main import main

if __name__ == "__main__":
    main()
