"""The engine: many processes, files, faults.

Detects: a data set that depends on who computed it or on what was killed, points computed twice,
images rendered for each of the points that share them, a failure that stops others or is silent.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress

import dask
import numpy as np
import pytest
from distributed import Client, LocalCluster, WorkerPlugin

from lidar_mi import __version__
from lidar_mi.campaign import engine, worker
from lidar_mi.campaign.collect import collect, open_campaign
from lidar_mi.campaign.engine import connected, execute, prepare_campaign, run_campaign
from lidar_mi.campaign.status import campaign_status
from lidar_mi.campaign.worker import run_point
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import silent
from tests.support.campaigns import described


def serial(path, folder):
    """All points one after the other in this process."""
    ready = prepare_campaign(path, folder)
    for number in range(len(ready.points)):
        run_point(ready, number)
    return collect(ready)


def same(one, other):
    """Equal bit by bit, NaN included, with the folders of the points."""
    assert one.identical(other)


class Faults(WorkerPlugin):
    """Makes points fail: those of some thickness raise, or kill their worker."""

    name = "faults"

    def __init__(self, raising=(), killing=()):
        self.raising, self.killing = raising, killing

    def setup(self, worker):
        from lidar_mi.campaign import worker as module

        self.before = prepare = module.prepare
        raising, killing = self.raising, self.killing

        def faulty(experiment, *more, **named):
            if experiment.scan.thickness in killing:
                os.kill(os.getpid(), signal.SIGKILL)
            if experiment.scan.thickness in raising:
                raise RuntimeError("a fault of the program")
            return prepare(experiment, *more, **named)

        module.prepare = faulty

    def teardown(self, worker):
        from lidar_mi.campaign import worker as module

        module.prepare = self.before


@pytest.fixture(scope="module")
def client():
    with connected(None, 2, 1, silent) as found:
        yield found


@pytest.mark.slow
def test_a_sweep_of_retrievals_renders_two_images(tmp_path, client):
    path = described(tmp_path, sweep={"retrieval.template": list(range(6, 10))})
    states = []
    found = run_campaign(path, tmp_path / "out", client=client, watch=states.append)
    state = states[-1]
    assert (state.done, state.failed) == (4, 0)
    assert (state.rendered, state.reused) == (2, 6)
    status = campaign_status(tmp_path / "out")
    assert (status.done, status.rendered, status.reused) == (4, 2, 6)
    assert found["retrieval.template"].values.tolist() == list(range(6, 10))
    # images that no point needs any more are gone
    assert not (tmp_path / "out" / "images").exists()
    # two processes and one give the same bits, and so does collecting again
    same(found, serial(path, tmp_path / "serial"))
    same(found, open_campaign(tmp_path / "out"))


@pytest.mark.slow
def test_a_detector_and_a_pulse_energy_need_no_new_images(tmp_path, client):
    sweep = {"lidar.pulse_energy": ["1 mJ", "9 mJ"], "sky": {"day": {"detector": {}}, "none": {}}}
    path = described(tmp_path, sweep=sweep)
    states = []
    found = run_campaign(path, tmp_path / "out", client=client, watch=states.append)
    assert (states[-1].rendered, states[-1].reused) == (2, 6)
    noise = found["detector.noise.all"].sel(sky="day")
    assert noise[0] > 2 * noise[1] and np.isnan(found["detector.noise.all"].sel(sky="none")).all()


@pytest.mark.slow
def test_a_failure_is_a_result_and_running_again_does_what_is_missing(tmp_path, client):
    path = described(tmp_path, sweep={"scan.thickness": ["2 m", "3 m"]}, members=2)
    client.register_plugin(Faults(raising=(2.0,)))
    try:
        found = run_campaign(path, tmp_path / "out", client=client)
    finally:
        client.unregister_worker_plugin("faults")
    assert found["status"].values.tolist() == [[1, 1], [0, 0]]
    failed = found.isel({"scan.thickness": 0})
    assert (failed["message"] == "a fault of the program").all()
    assert np.isnan(failed["backscatter.cc.valid_fraction"]).all()
    log = tmp_path / "out" / str(failed["folder"].values[0]) / "log.txt"
    assert "Traceback" in log.read_text() and "failed: a fault of the program" in log.read_text()
    assert "a fault of the program" in str(campaign_status(tmp_path / "out"))
    done = tmp_path / "out" / str(found["folder"].values[1, 0]) / "metrics.json"
    before = done.stat().st_mtime_ns
    mended = run_campaign(path, tmp_path / "out", client=client)
    assert (mended["status"] == 0).all() and done.stat().st_mtime_ns == before
    same(mended, serial(path, tmp_path / "serial"))


@pytest.mark.slow
def test_a_point_that_kills_its_worker_is_given_up_and_its_neighbours_are_not(tmp_path, client):
    path = described(tmp_path, sweep={"scan.thickness": ["1 m", "2 m", "3 m", "4 m"]})
    client.register_plugin(Faults(killing=(2.0,)))
    try:
        found = run_campaign(path, tmp_path / "out", client=client)
    finally:
        client.unregister_worker_plugin("faults")
    assert found["status"].values.tolist() == [0, 1, 0, 0]
    assert "its worker was killed 3 times" in str(found["message"].values[1])


@pytest.mark.slow
def test_the_scheduler_sees_paths_and_numbers_only(tmp_path, client, monkeypatch):
    path = described(tmp_path, sweep={"retrieval.template": [6, 8]}, members=2)
    sizes, submit = [], client.submit

    def weighed(function, *arguments, **options):
        futures = [a for a in arguments if not isinstance(a, list)]
        sizes.append(len(_packed(futures)))
        future = submit(function, *arguments, **options)
        future.add_done_callback(lambda done: sizes.append(len(_packed(done.result()))))
        return future

    monkeypatch.setattr(client, "submit", weighed)
    run_campaign(path, tmp_path / "out", client=client)
    assert len(sizes) >= 8 and max(sizes) < 10_000


def _packed(value):
    from distributed.protocol import dumps

    return b"".join(map(bytes, dumps(value)))


def test_what_a_campaign_refuses(tmp_path, client):
    path = described(tmp_path, sweep={"retrieval.template": [6, 8]})
    prepare_campaign(path, tmp_path / "out")
    other = described(tmp_path, name="other", sweep={"retrieval.template": [6, 10]})
    with pytest.raises(InputError, match="holds a campaign with another campaign"):
        run_campaign(other, tmp_path / "out", client=client)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="is no campaign's folder"):
        run_campaign(path, tmp_path / "mine", client=client)
    many = described(tmp_path, name="many", sweep={"retrieval.template": [6, 8]}, members=10**6)
    with pytest.raises(InputError, match="2000000 points are not allowed unasked"):
        run_campaign(many, tmp_path / "many", client=client)
    assert not (tmp_path / "many").exists()
    with pytest.raises(InputError, match=r"no campaign\.yaml in it"):
        open_campaign(tmp_path / "nothing")
    record = tmp_path / "out" / "campaign.yaml"
    text = record.read_text()
    assert f"version: {__version__}" in text
    record.write_text(text.replace(f"version: {__version__}", "version: 0.0.9"))
    with pytest.raises(InputError, match=r"version 0.0.9; expected another folder"):
        run_campaign(path, tmp_path / "out", client=client)


def test_a_scheduler_that_does_not_answer_and_a_worker_of_another_version(
    tmp_path, client, monkeypatch
):
    monkeypatch.setattr(engine, "PATIENCE", 0.5)
    with (
        pytest.raises(InputError, match=r"does not answer within 0\.5 s"),
        connected("tcp://127.0.0.1:9", None, 1, silent),
    ):
        pass
    monkeypatch.setattr(worker, "__version__", "9.9.9")
    with (
        pytest.raises(InputError, match=r"has lidar-mi .*; expected 9.9.9, as of the client"),
        connected(client, None, 1, silent),
    ):
        pass


def test_a_lifetime_that_is_too_short_begins_nothing(tmp_path, client):
    path = described(tmp_path, sweep={"retrieval.template": [6, 8]})
    ready = prepare_campaign(path, tmp_path / "out")
    state = execute(ready, client, watch=lambda state: None, lifetime=0.0)
    assert state.finished == 0 and (collect(ready)["status"] == 2).all()


def killer(cluster, random, every):
    """Kills a worker whenever so many points have ended, on a machine of any speed."""

    def watch(state):
        if state.done % every:
            return
        alive = [n.pid for n in cluster.workers.values() if getattr(n, "pid", None)]
        if alive:
            # one that has just ended needs no signal
            with suppress(ProcessLookupError):
                os.kill(int(random.choice(alive)), signal.SIGKILL)
                killed.append(state.done)

    killed = []
    return watch, killed


@pytest.mark.slow
def test_workers_and_clients_that_are_killed_cost_nothing(tmp_path):
    # 200 points; a worker is killed every 16 of them, which no point meets three times
    sweep = {"retrieval.template": list(range(4, 14)), "platform.dt": ["0.05 s", "0.1 s"]}
    path = described(tmp_path, sweep=sweep, members=10)
    random = np.random.default_rng(1)
    settings = {"distributed.scheduler.allowed-failures": 10**6}
    program = f"""
from lidar_mi.campaign.engine import run_campaign
if __name__ == "__main__":
    run_campaign({str(path)!r}, {str(tmp_path / "out")!r})
"""
    (tmp_path / "start.py").write_text(program)
    for some in (40, 80):  # the client is killed twice
        process = subprocess.Popen([sys.executable, tmp_path / "start.py"], start_new_session=True)
        while len(list((tmp_path / "out").glob("points/*/*/metrics.json"))) < some:
            assert process.poll() is None
            time.sleep(0.1)
        process.kill()
        process.wait()
    done = campaign_status(tmp_path / "out").done
    assert 0 < done < 200
    with (
        dask.config.set(settings),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        watch, killed = killer(cluster, random, 16)
        found = run_campaign(path, tmp_path / "out", client=client, watch=watch)
    assert len(killed) >= 3
    assert (found["status"] == 0).all()
    same(found, serial(path, tmp_path / "serial"))
    shutil.rmtree(tmp_path / "out")
