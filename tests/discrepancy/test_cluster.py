"""Refits of the loop on a Dask cluster of two workers, as a user would have it."""

import os
import signal
import threading
import time

import joblib
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.support.parallel import parallel_map
from tests.discrepancy.test_loop import FEW, fitted, machine

distributed = pytest.importorskip("distributed", reason="Dask is not installed")


@pytest.fixture(scope="module")
def cluster():
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as workers,
        distributed.Client(workers),
    ):
        yield workers


def process(item):
    return item, os.getpid()


def test_work_goes_to_the_workers_and_comes_back_in_order(cluster):
    with joblib.parallel_config(backend="dask"):
        found = parallel_map(process, list(range(20)))
    assert [item for item, _ in found] == list(range(20))
    assert os.getpid() not in {pid for _, pid in found}


def test_the_loop_runs_on_a_cluster(cluster):
    record = machine(weight=0.3)
    with joblib.parallel_config(backend="dask"):
        report = dgp.close_loop(
            fitted(record), record, effects=FEW[:1], max_rounds=1, progress=False
        )
    assert [one.name for one in report.effects] == ["extra input"]
    assert report.after["rmse"] < 0.06


def test_a_loop_whose_worker_is_killed_reports_the_same(cluster):
    """Dask starts another one, and does what was lost again."""
    record = machine(weight=0.3)
    fit, options = fitted(record), {"effects": FEW, "max_rounds": 1, "progress": False}
    client = distributed.default_client()
    busy, killed, ended = threading.Event(), [], threading.Event()

    def kill():
        while not ended.is_set() and not killed:
            working = [address for address, tasks in client.processing().items() if tasks]
            if working and busy.is_set():
                killed.append(client.run(os.getpid, workers=working[:1])[working[0]])
                os.kill(killed[0], signal.SIGKILL)
            elif working:
                busy.set()
            time.sleep(0.05)

    watch = threading.Thread(target=kill, daemon=True)
    watch.start()
    with joblib.parallel_config(backend="dask"):
        found = dgp.close_loop(fit, record, **options)
    ended.set()
    watch.join()
    assert len(killed) == 1
    alone = dgp.close_loop(fit, record, workers=1, **options)
    assert [one.decision for one in found.attempts] == [one.decision for one in alone.attempts]
    gains = [
        [one.gain for one in report.attempts if one.gain == one.gain] for report in (found, alone)
    ]
    assert gains[0] == gains[1]
    assert dict(found.after) == dict(alone.after)
