"""What the fuzz tests share: how many inputs, and bounds that turn a hang or a hunger for memory into a failure."""

import os
import signal
from contextlib import contextmanager

COUNT = int(os.environ.get("PAGAS_FUZZ", "80"))


@contextmanager
def bounded(seconds=5.0, more_bytes=3 << 30):
    """A hang becomes an exception, and so does asking for gigabytes."""
    import resource

    def late(*_):
        raise TimeoutError(f"took more than {seconds} s")

    before = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    handler = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    resource.setrlimit(resource.RLIMIT_AS, (used + more_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
