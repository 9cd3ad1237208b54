"""How many CPUs a process may use."""

import os
import sys

import pytest

from headway.cpus import num_cpus


def test_nproc_says_how_many_cpus(monkeypatch):
    monkeypatch.setenv("NPROC", "37")
    assert num_cpus() == 37


@pytest.mark.skipif(sys.platform != "linux", reason="asks the system for the affinity")
@pytest.mark.parametrize("no_number", ["", "0", "-2", "many"])
def test_otherwise_the_system_does(no_number, monkeypatch):
    monkeypatch.setenv("NPROC", no_number)
    assert num_cpus() == len(os.sched_getaffinity(0))
