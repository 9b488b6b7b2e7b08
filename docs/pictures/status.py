"""Draws the pictures of the live screen: the truck after its lidar was unplugged, the robot with sonars along a wall.

    python -m docs.pictures.status

Both are drives of the whole daemon on the virtual clock; Debian's chromium makes pictures of the screens.
"""

import asyncio
import io
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image
from rich.console import Console
from rich.terminal_theme import SVG_EXPORT_THEME

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_schemas.req import BehaviourOrder
from monstertruckd.config.load import load_config
from monstertruckd.tools.shipped import shipped
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from monstertruckd.tools.status.screen import ScreenState, draw
from monstertruckd.tools.status.watch import Follower
from tests.daemon.browser_kit import chromium

PICTURES = Path(__file__).resolve().parent
REAL = 1_790_000_000 * SECOND
"""The date on the screens, ns of UNIX time."""


async def unplugged(rig: VirtualRig, operator: LocalOperator) -> None:
    """The lap of the demo, until the lidar's plug is pulled."""
    await operator.arm()
    await rig.clock.sleep(16.0)
    rig.ports["lidar"].unplug()
    await rig.clock.sleep(2.0)


async def along_the_wall(rig: VirtualRig, operator: LocalOperator) -> None:
    """To the wall, and along it."""
    await operator.arm()
    await operator.behave(BehaviourOrder.START, "line_left")
    await rig.clock.sleep(19.0)


def screen(config: str, story: Callable[..., Any], width: int, height: int, folder: Path) -> str:
    """SVG of the screen at the end of a story."""
    loaded = load_config(shipped(config), SimulatedTruckConfig)[0]
    overlay = {"recorder": {"directory": str(folder / "logs")}, "state_directory": folder / "state"}

    async def main(clock: VirtualClock) -> str:
        clock.step_real(REAL / SECOND)
        state = ScreenState(f"{loaded.robot} on rover", clock.now())
        rig = VirtualRig(with_overlay(loaded, overlay), clock)
        async with rig.running():
            operator = LocalOperator(rig.daemon, clock)
            following = asyncio.create_task(Follower(operator, clock, state).run())  # type: ignore[arg-type]
            await clock.sleep(4.0)
            await story(rig, operator)
            following.cancel()
        console = Console(width=width, height=height, record=True, file=io.StringIO(), force_terminal=True)
        console.print(draw(state, width), height=height)
        return console.export_svg(theme=SVG_EXPORT_THEME, font_aspect_ratio=0.602, code_format=CODE)

    return run_virtual(main, start=SECOND)


CODE = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {terminal_width} {terminal_height}"
width="{terminal_width}" height="{terminal_height}"><style>
.{unique_id}-matrix {{ font: {char_height}px "DejaVu Sans Mono", monospace; }} {styles}</style>
<defs>{lines}</defs><rect width="100%" height="100%" fill="#1d1f27"/>
<g class="{unique_id}-matrix">{backgrounds}{matrix}</g></svg>"""
"""The screen alone, without the window that rich draws round it."""


async def shoot(screens: dict[str, str], folder: Path) -> None:
    """Have the browser make a picture of each."""
    async with chromium(folder) as browser:
        for name, svg in screens.items():
            page = await browser.new_page()
            await page.set_content(f"<body style='margin: 0'>{svg}</body>")
            shot = Image.open(io.BytesIO(await page.locator("svg").screenshot()))
            shot.quantize(64).save(PICTURES / f"{name}.png", optimize=True)


def main() -> None:
    """Draw both."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        screens = {
            "status": screen("configs/demo.yaml", unplugged, 112, 36, folder),
            "status-sonars": screen("configs/robots/sonar.yaml", along_the_wall, 80, 24, folder),
        }
        asyncio.run(shoot(screens, folder))


if __name__ == "__main__":
    main()
