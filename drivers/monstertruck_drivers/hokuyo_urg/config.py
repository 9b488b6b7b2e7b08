"""Configuration of the URG-04LX driver; the port is named elsewhere."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import FrameId, Schema


class HokuyoConfig(Schema):
    """How the scanner is driven; its geometry is always read from the sensor itself."""

    kind: Literal["hokuyo_urg"] = "hokuyo_urg"
    frame: FrameId = "lidar"
    """Frame of the published scans."""
    serial_number: str | None = None
    """Unit expected on this port (``SERI`` of VV); None accepts any URG."""
    scan_format: Literal["MD", "MS"] = "MD"
    """MD: three characters a range; MS: two, at most 4095 mm, two thirds of the bytes."""
    cluster: Annotated[int, Field(ge=1, le=99)] = 1
    """Neighbouring steps merged into one range; over RS232 use 2 or more, a full scan does not fit in 100 ms."""
    skip: Annotated[int, Field(ge=0, le=9)] = 0
    """Revolutions left out between two scans."""
    max_bad_scans: Annotated[int, Field(ge=0)] = 5
    """Damaged scans in a row that are tolerated before the session restarts."""
    stale_periods: Annotated[float, Field(gt=1)] = 5.0
    """Scan intervals without a good scan before the session restarts."""
    first_scan_periods: Annotated[float, Field(gt=1)] = 16.0
    """Scan intervals allowed for the first scan after starting."""
    line_timeout: Annotated[float, Field(gt=0)] = 0.14
    """Seconds of silence within the answer to a command."""
    verify_timeout: Annotated[float, Field(gt=0)] = 10.0
    """Seconds the sensor may take to verify a suspected fault of its own (statuses 21-49)."""
    clock_samples: Annotated[int, Field(ge=1, le=100)] = 12
    """Exchanges of the start-up clock comparison; the quickest one counts."""
