"""Live maps: frames as they come, or a recording at its own pace, are mapped and published while they are new.

>>> from ogm.live import FoxglovePublisher, serve, warm_up
>>> warm_up(ism, mapper)                                        # doctest: +SKIP
>>> with FoxglovePublisher(port=8765) as publisher:             # doctest: +SKIP
...     print(serve(frames, ism, mapper, publisher))
"""

from ogm.live.foxglove_server import FoxglovePublisher
from ogm.live.pipeline import LiveReport, serve, warm_up
from ogm.live.stream import receive_frames

__all__ = ["FoxglovePublisher", "LiveReport", "receive_frames", "serve", "warm_up"]
