"""Scans in packet captures (.pcap): those of Velodyne, by velodyne-decoder."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from amvnet.data.formats.cloud import (
    Cloud,
    check_point_count,
    make_cloud,
    reading,
    require,
    split_records,
)
from amvnet.data.formats.recording import Decode, Recording
from amvnet.errors import InputError

EXPECTED = "a capture of Velodyne's packets"
ADVICE = "capture it again"
FULL_INTENSITY = 255.0

PACKET_BYTES = 1206  # of Velodyne's data packets
PCAPNG = b"\x0a\x0d\x0d\x0a"  # first bytes, whatever the byte order
HEAD = 1 << 20  # bytes of a capture that are looked at
LEAST = 16  # bytes of a packet's header in a capture

# What other sensors send, by what turns a capture of it into files that are read.
CONVERTERS = {
    "Ouster": "pip install ouster-sdk, run ouster-cli source FILE.pcap save FILE.csv, and give the "
    "folder of the .csv",
    "Hesai": "export it as .pcd in PandarView 2, or as a bag with hesai_ros_driver",
    "Livox": "convert it to a bag with livox_ros_driver2",
    "RoboSense": "convert it to a bag with rslidar_sdk (msg_source 3)",
}


def open_capture(path: Path) -> Recording:
    """Open the scans in a capture of a Velodyne's packets, a turn of the sensor each.

    Lost returns are not in the packets, so not in the scans either. The packets name the model.

    Raises:
        InputError: if the packets are another sensor's or broken, or velodyne-decoder is missing.
    """
    maker = _maker_of(path)
    if maker != "Velodyne":
        advice = CONVERTERS.get(maker, "convert its packets with the sensor's own software")
        raise InputError(
            f"{path}: expected {EXPECTED}, found {maker or 'unknown'} packets; {advice}"
        )

    with reading(path, EXPECTED, ADVICE):
        count = sum(1 for _ in _decode(path))
    if not count:
        raise InputError(f"{path}: expected scans, found none in its packets; {ADVICE}")
    return Recording(path, count, partial(_decode, path), ADVICE)


def _decode(path: Path) -> Iterator[Decode]:
    """Yield what reads each scan."""
    require(path, "packets", "velodyne_decoder")
    import velodyne_decoder

    for _, records in velodyne_decoder.read_pcap(str(path), as_pcl_structs=True):
        yield partial(_read_scan, records)


def _read_scan(records: np.ndarray, name: str) -> Cloud:
    check_point_count(len(records), name)
    return replace(make_cloud(split_records(records), name), full=FULL_INTENSITY)


def _maker_of(path: Path) -> str:
    """Return the maker of the sensor whose packets are most frequent; empty if unknown.

    Raises:
        InputError: if the capture is a pcapng.
    """
    with path.open("rb") as file:
        head = file.read(HEAD)
    if head.startswith(PCAPNG):
        raise InputError(
            f"{path}: expected a capture in the format pcap, found pcapng; convert it with "
            "Wireshark's editcap -F pcap OLD NEW.pcap"
        )

    makers = Counter(map(_maker_of_packet, _packets(head)))
    del makers[""]
    return makers.most_common(1)[0][0] if makers else ""


def _packets(head: bytes) -> Iterator[bytes]:
    """Yield the packets of a capture, from the link layer on."""
    order = ">" if head[:1] == b"\xa1" else "<"
    position = 24
    while position + LEAST <= len(head):
        (length,) = struct.unpack_from(f"{order}I", head, position + 8)
        yield head[position + LEAST : position + LEAST + length]
        position += LEAST + length


def _maker_of_packet(packet: bytes) -> str:
    """Return the maker of the sensor that sent an Ethernet packet by UDP; empty if unknown."""
    ip = packet.find(b"\x08\x00\x45")
    if ip < 0 or len(packet) < ip + 30:
        return ""
    (port,) = struct.unpack_from(">H", packet, ip + 24)
    data = packet[ip + 30 :]

    if data[:2] == b"\xee\xff":
        return "Hesai"
    if data[:2] == b"\xff\xee" and len(data) >= PACKET_BYTES:
        return "Velodyne"
    if data[:2] == b"\x55\xaa":
        return "RoboSense"
    if 56000 <= port <= 57999:
        return "Livox"
    if port in (7502, 7503) or len(data) in (3392, 6464, 8448, 12608, 16640, 24832, 33024):
        return "Ouster"
    return ""
