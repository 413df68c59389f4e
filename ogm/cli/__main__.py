"""``python -m ogm.cli``."""

from ogm.cli import main

main()
