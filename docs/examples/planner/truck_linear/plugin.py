"""The row of the table of trackers."""

from monstertruck_runtime.plugins import Plugin

LINEAR = Plugin(
    name="linear",
    settings="truck_linear.config:LinearConfig",
    implementation="truck_linear.tracker:LinearFeedback",
    doc="Linear feedback of lateral and heading error",
)
