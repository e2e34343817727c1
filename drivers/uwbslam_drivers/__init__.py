"""Drivers: bytes of LiDARs and UWB radios become host messages. `open_source` opens a device by its URL."""

from uwbslam_drivers.source import Source as Source, open_source as open_source
