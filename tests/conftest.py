"""What every test starts from."""

from __future__ import annotations

import signal

# A background job without job control starts with SIGINT ignored, and programs it starts inherit that: tests that interrupt
# a program would then wait for nothing.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
