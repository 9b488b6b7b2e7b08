"""YAML 1.2 files of plain data."""

import io
from pathlib import Path
from typing import Any, Final

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.small_files import require_file

MOST_BYTES: Final = 1_000_000
"""Size of one file at most: they are written by hand, or give the origin of a map."""


def read_yaml(path: Path) -> Any:
    """Content of a file.

    Raises:
        InputError: it cannot be read, or is not YAML.
    """
    try:
        require_file(path, MOST_BYTES)
        return YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise InputError(f"{path}:{line}: not valid YAML: {error.problem}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, YAMLError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as YAML: {error}") from error


def yaml_text(value: Any) -> str:
    """Plain data as YAML in block style; keys stay in their order."""
    yaml, text = YAML(typ="safe", pure=True), io.StringIO()
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # its annotation knows None only
    yaml.dump(value, text)
    return text.getvalue()
