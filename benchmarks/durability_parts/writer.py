"""A subject's writer as a separate process whose changes are traced: SUBJECT FOLDER SEED CHANGES."""

import sys
from pathlib import Path

from benchmarks.durability_parts.deaths import SUBJECTS, work

if __name__ == "__main__":
    name, folder, seed, changes = sys.argv[1:]
    work(next(subject for subject in SUBJECTS if subject.name == name), Path(folder), int(seed), most=int(changes))
