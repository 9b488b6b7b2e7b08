"""Settings of the range finder."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import Schema


class Mb7360Config(Schema):
    """MaxBotix MB7360."""

    kind: Literal["mb7360"] = "mb7360"
    timeout: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Timeout without a reading (s); then the session ends"""
