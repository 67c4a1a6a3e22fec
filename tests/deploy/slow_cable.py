"""A slow cable between two network devices: ``python slow_cable.py ONE OTHER SECONDS BITS_A_SECOND``, until killed.

In the place of tc-netem, which many kernels lack. Frames come and go with the kernel's own notes (PACKET_VNET_HDR), as
long segments and checksums are left to devices.
"""

import heapq
import select
import socket
import sys
import time
from itertools import count

_ALL_PROTOCOLS, _SOL_PACKET, _PACKET_VNET_HDR, _PACKET_IGNORE_OUTGOING = 3, 263, 15, 23
_LONGEST = 2**17


def end_of(device: str) -> socket.socket:
    """A socket that gets what comes into a device, and sends out of it."""
    found = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ALL_PROTOCOLS))
    found.setsockopt(_SOL_PACKET, _PACKET_VNET_HDR, 1)
    found.setsockopt(_SOL_PACKET, _PACKET_IGNORE_OUTGOING, 1)
    found.bind((device, 0))
    return found


def main(one: str, other: str, delay: float, rate: float) -> None:
    ends = [end_of(one), end_of(other)]
    to = {ends[0]: ends[1], ends[1]: ends[0]}
    busy_until = dict.fromkeys(ends, 0.0)
    on_the_way: list[tuple[float, int, socket.socket, bytes]] = []
    numbers = count()
    while True:
        wait = max(0.0, on_the_way[0][0] - time.monotonic()) if on_the_way else None
        for end in select.select(ends, [], [], wait)[0]:
            frame = end.recv(_LONGEST)
            busy_until[end] = max(busy_until[end], time.monotonic()) + 8 * len(frame) / rate
            heapq.heappush(on_the_way, (busy_until[end] + delay, next(numbers), to[end], frame))
        while on_the_way and on_the_way[0][0] <= time.monotonic():
            _, _, end, frame = heapq.heappop(on_the_way)
            end.send(frame)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]), float(sys.argv[4]))
