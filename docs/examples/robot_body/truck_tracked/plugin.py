"""The row of the table of bodies."""

from monstertruck_runtime.plugins import Plugin

TRACKED = Plugin(
    name="tracked",
    settings="truck_tracked.config:TrackedBody",
    implementation="truck_tracked.chassis:tracked_chassis",
    doc="Two tracks that turn the body by skidding",
)
