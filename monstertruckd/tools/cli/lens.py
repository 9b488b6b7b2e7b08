"""``monstertruckd convert-lens``: camera intrinsics from and for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.lens_forms import LensForm


def convert_lens(
    file: Annotated[
        Path,
        typer.Argument(
            help="Intrinsics of ROS, kalibr or OpenCV (YAML), or a robot's configuration.", show_default=False
        ),
    ],
    output: Annotated[Path | None, typer.Argument(help="File to write; default: standard output.")] = None,
    form: Annotated[LensForm, typer.Option("--format", "-f", help="Form of the output.")] = LensForm.CONFIG,
    camera: Annotated[
        str | None, typer.Option(help="Name in a chain of cameras, e.g. cam0.", show_default=False)
    ] = None,
    size: Annotated[
        str | None, typer.Option(help="Pixels, e.g. 640x480, if the file states none.", show_default=False)
    ] = None,
) -> None:
    """Write camera intrinsics in another form; `config` is the section `devices.camera.driver.lens`."""
    from monstertruck_runtime.lens_files import EXPECTED, lens_from, lens_text
    from monstertruck_runtime.outside import text_of
    from monstertruck_runtime.small_files import replace_file
    from monstertruck_runtime.yaml_files import LARGEST_YAML
    from monstertruck_schemas.body import LensConfig
    from monstertruckd.tools.simulation.config import load_robot

    text = text_of(file, EXPECTED, LARGEST_YAML)
    if "\ndevices:" in f"\n{text}":
        device = load_robot(file)[0].devices.camera
        lens = None if device is None else getattr(device.driver, "lens", None)
        if not isinstance(lens, LensConfig):
            raise InputError(f"{file}: has no camera whose lens it states")
    else:
        lens = lens_from(text, file, camera=camera, size=_pixels(size))
    written = lens_text(lens, form)
    if output is None:
        typer.echo(written, nl=False)
    else:
        replace_file(output, written.encode())


def _pixels(size: str | None) -> tuple[int, int] | None:
    if size is None:
        return None
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size {size}: expected WIDTHxHEIGHT, e.g. 640x480")
    return int(width), int(height)
