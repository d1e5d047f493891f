"""Refits of the loop on a Dask cluster of two workers, as a user would have it."""

import os

import distributed
import joblib
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.support.parallel import parallel_map
from tests.discrepancy.test_loop import FEW, fitted, machine


@pytest.fixture(scope="module")
def cluster():
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as workers,
        distributed.Client(workers),
    ):
        yield


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
