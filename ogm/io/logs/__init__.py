"""Logs: ROS 1 bags, ROS 2 bags and MCAP, read without ROS, also if cut short, and written.

>>> from ogm.io.logs import open_log
>>> with open_log("drive.mcap") as log:                           # doctest: +SKIP
...     print(log.topics)
...     for message in log.messages(["/points"]):
...         cloud = message.decode()
"""

from ogm.io.logs.definitions import LOG_ENDINGS, log_ending
from ogm.io.logs.reader import LogMessage, LogReader, TopicFacts, open_log
from ogm.io.logs.writer import LogWriter

__all__ = ["LOG_ENDINGS", "LogMessage", "LogReader", "LogWriter", "TopicFacts", "log_ending", "open_log"]
