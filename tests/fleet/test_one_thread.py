"""The library's entry points limit BLAS to one thread, unless the caller sets the number."""

from __future__ import annotations

import threadpoolctl

from ahrsd.offline.calibrate import calibrate
from ahrsd.offline.diagnose import diagnose_recording
from ahrsd.offline.evaluate import evaluate
from ahrsd.offline.replay import replay
from ahrsd.recording.limits import on_one_thread


def threads() -> list[int]:
    found = threadpoolctl.threadpool_info()
    return [one["num_threads"] for one in found if one["user_api"] == "blas"]


def test_thread_number_is_one_during_a_call_and_restored(monkeypatch):
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = threads()
        assert max(before) == 2
        assert set(on_one_thread(threads)()) == {1}
        assert threads() == before


def test_number_set_by_the_caller_is_kept(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        assert max(on_one_thread(threads)()) == 2


def test_every_entry_point_is_limited():
    entries = (calibrate, diagnose_recording, evaluate, replay)
    assert all(hasattr(entry, "__wrapped__") for entry in entries)
