"""Worker threads: PyTorch's settings are restored, order is kept, and concurrent fits are independent."""

import threading
import time

import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.threads import ThreadPool, resolve_num_threads

QUICK = FitConfig(
    num_threads=2, training={"sdf_iterations": 20, "intensity_iterations": 20, "batch_size": 1024}
)


@pytest.fixture(autouse=True)
def two_threads():
    """Simulates two processors, and restores settings after a failing test."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_torch_has_one_thread_inside_and_is_restored_after():
    with ThreadPool(3) as pool:
        assert torch.get_num_threads() == 1
        assert set(pool.map(lambda _: torch.get_num_threads(), range(8))) == {1}
    assert torch.get_num_threads() == 2


def test_an_error_on_a_worker_is_raised_and_settings_are_restored():
    def fail(item):
        if item == 5:
            msg = "item 5"
            raise LookupError(msg)
        return item

    for threads in (1, 2):
        with ThreadPool(threads) as pool, pytest.raises(LookupError, match="item 5"):
            list(pool.map(fail, range(100)))
        assert torch.get_num_threads() == 2


def test_blocks_nest():
    with ThreadPool(2):
        with ThreadPool() as inner:
            assert inner.num_threads == 2  # not the 1 that the outer block has set
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2
    with pytest.raises(KeyError), ThreadPool(2), ThreadPool(2):
        raise KeyError
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize("first_in_is_first_out", [True, False])
def test_blocks_of_several_threads(first_in_is_first_out):
    entered, leave = threading.Event(), threading.Event()
    seen = {}

    def other():
        torch.set_num_threads(2)
        with ThreadPool(0) as pool:
            seen["pool"] = pool.num_threads
            entered.set()
            leave.wait(10)
            seen["inside"] = torch.get_num_threads()
        seen["after"] = torch.get_num_threads()

    thread = threading.Thread(target=other)
    try:
        with ThreadPool(2):
            thread.start()
            assert entered.wait(10)
            if not first_in_is_first_out:
                leave.set()
                thread.join()
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    finally:
        leave.set()
        thread.join()
    assert seen == {"pool": 2, "inside": 1, "after": 2}
    # The number of PyTorch threads is thread-local: it must be restored in all threads.
    assert torch.get_num_threads() == 2
    fresh = []
    thread = threading.Thread(target=lambda: fresh.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert fresh == [2]


@pytest.mark.parametrize("num_threads", [1, 2, 5])
def test_results_keep_the_order_of_the_items(num_threads):
    def late_first(item):
        time.sleep(0.01 * (5 - item))
        return item, threading.current_thread().name

    with ThreadPool(num_threads) as pool:
        results = list(pool.map(late_first, range(5)))
        assert list(pool.map(str, [])) == []
        assert list(pool.map(str, [7])) == ["7"]
    assert [item for item, _ in results] == list(range(5))
    assert len({name for _, name in results}) == num_threads


def test_grad_mode_is_each_threads_own():
    with torch.no_grad(), ThreadPool(2) as pool:
        assert list(pool.map(lambda _: torch.is_grad_enabled(), range(2))) == [True, True]


def test_zero_threads_are_as_many_as_torch_has():
    assert resolve_num_threads(0) == 2
    assert resolve_num_threads(7) == 7
    with ThreadPool(5):
        assert resolve_num_threads(0) == 2


def fitted(scene, seed):
    config = QUICK.override(seed=seed)
    return radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)


def test_concurrent_fits_equal_sequential_fits(scene):
    in_turn = [fitted(scene, seed) for seed in (0, 1)]
    at_once = [None, None]
    start = threading.Barrier(2)

    def work(seed):
        start.wait()
        at_once[seed] = fitted(scene, seed)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for one, other in zip(in_turn, at_once, strict=True):
        for name, value in one.field.state_dict().items():
            assert torch.equal(value, other.field.state_dict()[name]), name
    assert torch.get_num_threads() == 2
