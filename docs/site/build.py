"""Builds the documentation as a site, strictly, into ``runs/site``: ``python docs/site/build.py [OTHER_FOLDER]``."""

import os
import sys
from pathlib import Path

os.environ["NO_MKDOCS_2_WARNING"] = "1"  # before the theme loads: its makers' announcement is none of the build's

sys.path.insert(1, str(Path(__file__).resolve().parents[2]))  # the pages read benchmarks/

from mkdocs.__main__ import cli

if __name__ == "__main__":
    folder = ["--site-dir", str(Path(sys.argv[1]).absolute())] if sys.argv[1:] else []
    cli(["build", "--strict", "--config-file", str(Path(__file__).with_name("mkdocs.yml")), *folder])
