"""Live maps: map and publish frames of a driver as they arrive, or of a recording in real time.

>>> from ogm.live import FoxglovePublisher, serve, warm_up
>>> warm_up(ism, mapper)                                        # doctest: +SKIP
>>> with FoxglovePublisher(port=8765) as publisher:             # doctest: +SKIP
...     print(serve(frames, ism, mapper, publisher))
"""

from ogm.live.foxglove_server import FoxglovePublisher
from ogm.live.pipeline import LiveReport, serve, warm_up
from ogm.live.stream import receive_frames

__all__ = ["FoxglovePublisher", "LiveReport", "receive_frames", "serve", "warm_up"]
