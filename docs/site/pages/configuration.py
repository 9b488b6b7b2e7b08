"""Configuration reference, generated from the models that validate it: one page per section."""

from collections.abc import Iterator

from monstertruck_drivers.catalog import DEVICES
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from pages.markdown import Page, join
from pages.models import Definitions, Json, label, plain

DRIVER = "The settings under `driver` are on the page of the device kind."
DRIVERS = {kind.settings_class().__name__: kind for kind in DEVICES.values()}


def pages() -> list[Page]:
    """Return the overview and a page per section."""
    models = Definitions(SimulatedTruckConfig)
    sections = {name: field for name, field in models.root["properties"].items() if any(models.models_in(field))}
    places = {model: f"{name}.md" for name, field in sections.items() for model in models.models_in(field)}
    text = join(
        "# Configuration",
        "A robot or experiment is one YAML file. `include: FILE` merges it over another file, relative "
        "to its own folder. Unknown keys are refused with file, line and a suggestion. `monstertruckd config "
        "show FILE` prints the result with the origin of each value. The defaults describe the thesis author's truck.",
        models.fields(models.root, places.get),
        "Only simulated trucks have `sim`.",
    )
    first = Page("configuration/index.md", "The file", text)
    return [first, *(_section(models, name, field) for name, field in sections.items())]


def _section(models: Definitions, key: str, field: Json) -> Page:
    found = dict(_walk(models, key, field))
    anchors = {name: f"#{_anchor(heading)}" for heading, name in found.items()}

    def link(name: str) -> str | None:
        driver = DRIVERS.get(name.removeprefix("Device_").rstrip("_"))
        return f"../devices/{driver.name}.md" if driver is not None else anchors.get(name)

    kinds = list(models.models_in(field))
    common = models.common(kinds)
    here = f"The section `{key}:` of a configuration: every key with its type, default and meaning."
    parts = [f"# {key}", here, plain(field.get("description", ""))]
    if common:
        alike = frozenset(models[kinds[0]]["properties"]) - common
        parts += ["## Every kind", models.fields(models[kinds[0]], link, alike)]
    for heading, name in found.items():
        model = models[name]
        if heading != key:
            parts.append(f"## `{heading}` {{ #{_anchor(heading)} }}")
        about = plain(model.get("description", ""))
        if "driver" in model["properties"]:
            parts += [about, models.fields(model, link, frozenset({"driver"})), DRIVER]
        else:
            parts += [about, models.fields(model, link, common if name in kinds else frozenset())]
    return Page(f"configuration/{key}.md", key, join(*parts))


def _walk(models: Definitions, key: str, field: Json) -> Iterator[tuple[str, str]]:
    """Yield headings and models, outermost first and each once; drivers have separate pages."""
    waiting, seen = [(key, field)], set()
    while waiting:
        at, schema = waiting.pop(0)
        names = [name for name in models.models_in(schema) if name not in DRIVERS]
        for name in names:
            if _one_of_all(name) in seen:
                continue
            seen.add(_one_of_all(name))
            inside = "devices.<role>" if name.startswith("Device_") else at
            kind = label(models[name], name)
            yield (f"{inside}, {kind.strip('`')}" if len(names) > 1 else inside), name
            waiting += [(f"{inside}.{inner}", value) for inner, value in models[name]["properties"].items()]


def _one_of_all(name: str) -> str:
    """Map all device models to one: they differ only in their drivers."""
    return "Device" if name.startswith("Device_") else name


def _anchor(heading: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in heading.lower()).strip("-")
