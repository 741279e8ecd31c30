"""Files to point clouds and poses, and back."""

from cgf.io.clouds import CLOUD_SUFFIXES, read_cloud, write_cloud
from cgf.io.libraries import import_open3d
from cgf.io.pairs import PairFiles, logged_pairs, numbered_clouds, read_pairs
from cgf.io.poses import (
    InfoEntry,
    LogEntry,
    index_in_name,
    read_info,
    read_log,
    read_transform,
    write_log,
    write_transform,
)

__all__ = [
    "CLOUD_SUFFIXES",
    "InfoEntry",
    "LogEntry",
    "PairFiles",
    "import_open3d",
    "index_in_name",
    "logged_pairs",
    "numbered_clouds",
    "read_cloud",
    "read_info",
    "read_log",
    "read_pairs",
    "read_transform",
    "write_cloud",
    "write_log",
    "write_transform",
]
