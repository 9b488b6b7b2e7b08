"""Plug-ins: implementations of each ``kind`` in the configuration, from this repository or another distribution.

A catalog has one ``Plugin`` per kind. The settings model is loaded to check a configuration and must be light. The
implementation is loaded on use, so that listing kinds, ``--help`` and checking a configuration stay fast. Other
distributions add rows through entry points that refer to a ``Plugin``::

    [project.entry-points."monstertruck.trackers"]
    mine = "my_package.plugin:MINE"
"""

import importlib
import inspect
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Generic, Literal, TypeVar, cast, get_args, get_origin

from pydantic import BaseModel, GetCoreSchemaHandler, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, core_schema

from monstertruck_runtime.errors import InputError, TruckError, first_of
from monstertruck_schemas.base import Schema
from monstertruck_schemas.entry_points import ExtensibleTable


def load(place: str) -> Any:
    """Load the object at ``module:name``.

    Raises:
        ImportError: the module does not exist, or needs one that is not installed.
        AttributeError: the module has no such name.
    """
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


@dataclass(frozen=True, kw_only=True)
class Plugin:
    """One kind that a configuration can choose; a catalog may use a subclass with more columns."""

    name: str
    """Value of ``kind`` in a configuration."""
    settings: str
    """Place ``module:Class`` of its settings, a ``Schema`` with ``kind: Literal[name]``."""
    implementation: str
    """Place ``module:Class`` of the implementation; the catalog's user defines its arguments."""
    doc: str
    """Description in one line, for lists."""
    extra: str | None = None
    """Extra of the distribution without which the implementation does not load."""

    def settings_class(self) -> type[Schema]:
        """Model of its section in the configuration; loads its module."""
        return cast("type[Schema]", load(self.settings))

    def implementation_class(self) -> Any:
        """Implementation; loads its module.

        Raises:
            InputError: it does not load, or is not a class.
        """
        return self.callable_at(self.implementation)

    def build(self, *arguments: Any, **named: Any) -> Any:
        """Return an instance of the implementation.

        Raises:
            InputError: it does not load, or takes other arguments.
        """
        return self.called(self.implementation, *arguments, **named)

    def callable_at(self, place: str) -> Callable[..., Any]:
        """Class or function at ``module:name``; loads its module.

        Raises:
            InputError: it does not load, or cannot be called.
        """
        try:
            found = load(place)
        except (ImportError, AttributeError) as error:
            needs = "" if self.extra is None else f"needs the extra [{self.extra}]: "
            raise InputError(f"kind {self.name}: {place}: {needs}{error}") from error
        except (Exception, SystemExit) as error:  # any exception of the plug-in's module
            raise InputError(f"kind {self.name}: {place}: {type(error).__name__}: {error}") from error
        if not callable(found):
            raise InputError(f"kind {self.name}: {place}: expected a class or a function, found {found!r}")
        return cast("Callable[..., Any]", found)

    def called(self, place: str, *arguments: Any, **named: Any) -> Any:
        """Call the class or function at ``module:name`` and return its result.

        Raises:
            InputError: see ``callable_at``; or it takes other arguments.
        """
        make = self.callable_at(place)
        try:
            inspect.signature(make).bind(*arguments, **named)
        except (TypeError, ValueError) as error:
            given = ", ".join([*(type(one).__name__ for one in arguments), *(f"{name}=" for name in named)])
            text = f"expected to be called with ({given}), found {make!r}: {error}"
            raise InputError(f"kind {self.name}: {place}: {text}") from error
        with self.refusing(place):
            return make(*arguments, **named)

    @contextmanager
    def refusing(self, place: str) -> Iterator[None]:
        """Context for calls into a plug-in's code: converts its exceptions to errors that name their place.

        Raises:
            InputError: the code raised an exception other than our errors.
        """
        try:
            yield
        except Exception as error:
            if (ours := first_of(error, TruckError)) is not None:
                raise ours from None
            cause = first_of(error, Exception) or error
            frame = traceback.extract_tb(cause.__traceback__)[-1]
            text = f"{frame.filename}:{frame.lineno}: {type(cause).__name__}: {cause}"
            raise InputError(f"kind {self.name}: {place}: {text}") from error

    def default_settings(self) -> Schema:
        """Settings with all defaults.

        Raises:
            InputError: a field has no default.
        """
        model = self.settings_class()
        try:
            return model()
        except ValidationError as error:
            keys = ", ".join(str(one["loc"][-1]) for one in error.errors(include_url=False) if one["loc"])
            raise InputError(f"kind {self.name}: {self.settings}: {keys}: expected a default") from error


P = TypeVar("P", bound=Plugin)


class Catalog(ExtensibleTable[P], Generic[P]):
    """All plug-ins of one group by kind: built-in ones in the given order, then those of other distributions.

    Settings models of other distributions are loaded with their entry points, built-in ones on first use.

    Args:
        group: group of the entry points.
        rows: built-in rows; other distributions must provide the same class.
        base: base class of the settings models.
    """

    def __init__(self, group: str, *rows: P, base: type[Schema] = Schema) -> None:
        super().__init__(group, rows)
        self._base, self._row_class = base, type(rows[0])

    def fault(self, row: Any) -> str | None:
        """Return an error in a plug-in entry of another distribution, or None."""
        if not isinstance(row, self._row_class):
            return f"expected a {self._row_class.__name__}, found {type(row).__name__}"
        model: Any = row.settings_class()
        if not (isinstance(model, type) and issubclass(model, self._base)):
            return f"{row.settings}: expected a subclass of {self._base.__name__}"
        if kind_of(model) != row.name:
            return f'{row.settings}: expected a field `kind: Literal["{row.name}"]`'
        return wrong_default(model, row.settings)

    @cached_property
    def settings(self) -> Mapping[str, type[Schema]]:
        """Settings models by kind."""
        return {name: row.settings_class() for name, row in self.items()}

    def find(self, name: str) -> P:
        """Return the row of a kind.

        Raises:
            InputError: the kind is unknown.
        """
        if name not in self:
            raise InputError(f"{self.group}: no kind {name!r}: expected one of {', '.join(self)}")
        return self[name]

    def implementation(self, config: Schema) -> Any:
        """Return the implementation for settings of one of the kinds.

        Raises:
            InputError: unknown kind, or it does not load.
        """
        return self.find(str(vars(config).get("kind"))).implementation_class()

    def build(self, config: Schema, *arguments: Any, **named: Any) -> Any:
        """Return an instance of the implementation for settings of one of the kinds.

        Args:
            config: settings.
            arguments: positional arguments of the implementation, including the settings.
            named: keyword arguments.

        Raises:
            InputError: unknown kind, or the implementation does not load or has other arguments.
        """
        return self.find(str(vars(config).get("kind"))).build(*arguments, **named)

    def section(self, default: str | None = None) -> "KindSection":
        """Annotation of a configuration field that contains the settings of one of the kinds.

        For instance ``tracker: Annotated[TrackerConfig, TRACKERS.section()]``.

        Args:
            default: kind of a section without ``kind``; None if it is required.
        """
        return KindSection(self, default)


@dataclass(frozen=True, eq=False)
class KindSection:
    """Makes a field the tagged union of a catalog's settings models."""

    catalog: Catalog[Any]
    default: str | None

    @property
    def models(self) -> tuple[type[Schema], ...]:
        """Return the models that the section may hold."""
        return tuple(self.catalog.settings.values())

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema of the union, discriminated by ``kind``."""
        choices = {name: handler.generate_schema(model) for name, model in self.catalog.settings.items()}
        return core_schema.tagged_union_schema(choices, "kind" if self.default is None else self._kind)

    def _kind(self, section: Any) -> Any:
        if isinstance(section, dict):
            return section.get("kind", self.default)
        return getattr(section, "kind", None)


def wrong_default(model: type[BaseModel], place: str) -> str | None:
    """Return the first field of a model whose default violates its annotation; None if all are valid."""
    for name, field in model.model_fields.items():
        if field.is_required():
            continue
        annotation: Any = Annotated[field.annotation, field, *field.metadata]
        try:
            TypeAdapter(annotation).validate_python(field.get_default(call_default_factory=True, validated_data={}))
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            return f"{place}: {name}: {first['msg']}, found the default {first['input']!r}"
    return None


def kind_of(model: type[BaseModel]) -> str | None:
    """Return the single kind of a settings model; None for other models."""
    field = model.model_fields.get("kind")
    if field is None or get_origin(field.annotation) is not Literal:
        return None
    kinds = get_args(field.annotation)
    return str(kinds[0]) if len(kinds) == 1 else None


def classes_in(annotation: Any) -> Iterator[type[Any]]:
    """Yield all classes in an annotation, including the settings models of catalogs."""
    if isinstance(annotation, KindSection):
        yield from annotation.models
    elif isinstance(annotation, type):
        yield annotation
    for argument in get_args(annotation):
        yield from classes_in(argument)


def models_in(field: FieldInfo) -> Iterator[type[BaseModel]]:
    """Yield all models that a field of a model may contain."""
    for annotation in (field.annotation, *field.metadata):
        for cls in classes_in(annotation):
            if issubclass(cls, BaseModel):
                yield cls
