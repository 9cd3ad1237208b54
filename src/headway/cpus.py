"""The CPUs that this process may use."""

import os


def num_cpus() -> int:
    """CPUs that this process may use; `NPROC` overrides what the system says, as it does for XLA.

    A value of `NPROC` that is no positive number counts as none.
    """
    wanted = os.environ.get("NPROC", "")
    if wanted.isdecimal() and int(wanted) > 0:
        return int(wanted)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
