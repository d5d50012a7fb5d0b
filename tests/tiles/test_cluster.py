"""Tiles on dask.distributed: no bit changes, and finished tiles are kept."""

from concurrent.futures import Future

import pytest

distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")

import radarsdf
from radarsdf.tiles.fit_tiles import cluster_executor
from radarsdf.tiles.plan import map_path

from .cluster import bits_of, cluster_in
from .conftest import CONFIG, TILE_M


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with cluster_in(tmp_path_factory.mktemp("cluster") / "first") as found:
        with distributed.Client(found.address) as client:  # workers connect later
            client.wait_for_workers(1, timeout=60)
        yield found


def test_fits_on_a_cluster_change_no_bit(cluster, drive, folder, tmp_path):
    with cluster_executor(cluster.address, 0) as executor:
        options = {"tile_size": TILE_M, "halo": 6.4, "executor": executor, "config": CONFIG}
        city = radarsdf.fit_tiles(drive, tmp_path / "city", **options, progress=False)
    assert city.missing == {}
    assert bits_of(tmp_path / "city") == bits_of(folder)


def test_a_tile_beyond_the_memory_of_all_workers_is_rejected(cluster):
    with (
        pytest.raises(MemoryError, match="make the plan with smaller tiles"),
        cluster_executor(cluster.address, 10**15),
    ):
        pass


def test_an_address_without_a_cluster(monkeypatch):
    monkeypatch.setattr("radarsdf.tiles.fit_tiles._CONNECT_S", 0.5)
    with pytest.raises(OSError, match="Timed out"), cluster_executor("tcp://127.0.0.1:9", 0):
        pass


class CutOff:
    """A client of dask.distributed without a scheduler: futures that never complete, and a closed client."""

    class _client:
        status = "running"

    def submit(self, task, *arguments):
        future = Future()
        if arguments[1] == "0_0":
            future.set_result(task(*arguments))
        else:
            self._client.status = "closed"
        return future


def test_a_lost_scheduler_is_an_error_and_finished_tiles_are_kept(drive, folder, tmp_path):
    out = tmp_path / "city"
    arguments = {"tile_size": TILE_M, "halo": 6.4, "config": CONFIG, "progress": False}
    city = radarsdf.fit_tiles(drive, out, executor=CutOff(), **arguments)
    assert [tile.name for tile in city.tiles] == ["0_0"]
    assert set(city.missing.values()) == {"the scheduler is gone: call again, finished tiles are kept"}
    written_ns = map_path(out, city.tiles[0]).stat().st_mtime_ns
    assert radarsdf.fit_tiles(drive, out, **arguments).missing == {}
    assert map_path(out, city.tiles[0]).stat().st_mtime_ns == written_ns
    assert bits_of(out) == bits_of(folder)
