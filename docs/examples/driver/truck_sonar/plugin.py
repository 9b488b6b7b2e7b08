"""Catalog rows of the range finder."""

from monstertruck_drivers.catalog import DeviceKind, Duty, RoleSpec, UsbIdentity
from monstertruck_schemas.topics import Topic, Writer
from truck_sonar.message import SonarRange
from truck_sonar.protocol import BAUD

TOPIC = Topic("sensor/ranger", SonarRange, Writer.DRIVER, "Distance straight ahead", rate=7.5, stale_after=0.5)

RANGER = RoleSpec(
    name="ranger",
    duty=Duty.SENSOR,
    doc="Ultrasonic range finder",
    writes={"out": TOPIC},
    frame=True,
)

KIND = DeviceKind(
    name="mb7360",
    doc="MaxBotix MB7360 ultrasonic range finder",
    roles=(RANGER,),
    settings="truck_sonar.config:Mb7360Config",
    implementation="truck_sonar.driver:Mb7360Driver",
    emulator="truck_sonar.emulator:emulated",
    identity="truck_sonar.identity:identify",
    baud=BAUD,
    usb=UsbIdentity("0403:6001", "FT232R USB UART", "ttyUSB"),
)
