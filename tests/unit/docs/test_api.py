"""The public names of the Python API are pinned: what changes one needs a new major version."""

import importlib
import inspect
import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

ROOT = Path(__file__).resolve().parents[3]
PINNED = ROOT / "tests" / "data" / "api.json"


@pytest.fixture
def api(site_module):
    return site_module("api")


def parameters(of: Any) -> list[str]:
    """Parameters by name, each with its kind where it has no default."""
    return [
        f"{each.name}{'' if each.default is each.empty else '?'}{'*' if each.kind is each.KEYWORD_ONLY else ''}"
        for each in inspect.signature(of).parameters.values()
    ]


def shape(of: Any) -> Any:
    """What callers rely on: parameters of a function, fields and methods of a class, the kind of a constant."""
    if inspect.isfunction(of):
        return parameters(of)
    if not inspect.isclass(of):
        return type(of).__name__
    fields = {name: "field" if field.is_required() else "field?" for name, field in _fields(of).items()}
    members = {name: inspect.getattr_static(of, name) for name in dir(of) if _ours(of, name)}
    methods = {
        name: parameters(getattr(member, "__func__", member))
        if callable(member) or isinstance(member, (classmethod, staticmethod))
        else "attribute"
        for name, member in members.items()
    }
    return fields | {name: kind for name, kind in methods.items() if name not in fields}


def _fields(of: type) -> dict[str, Any]:
    return dict(of.model_fields) if issubclass(of, BaseModel) else {}


def _ours(of: type, name: str) -> bool:
    owner = next((base for base in of.__mro__ if name in vars(base)), object)
    return not name.startswith("_") and owner.__module__.startswith("monstertruck")


def test_the_public_names_are_as_they_were(api, tmp_path: Path):
    found = {
        f"{module}.{name}": shape(getattr(importlib.import_module(module), name))
        for module, names in api.used().items()
        for name in names
    }
    now = tmp_path / PINNED.name
    now.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
    pinned = json.loads(PINNED.read_text())
    changed = sorted(name for name in found.keys() | pinned.keys() if found.get(name) != pinned.get(name))
    assert changed == [], f"taken away or changed only with a major version; if it is meant: cp {now} {PINNED}"
