"""Freed memory is reused in a block of `KeptMemory`, and large arrays return to the system after it."""

import platform

import numpy as np
import pytest
from radarsdf._core import KeptMemory

resource = pytest.importorskip("resource", reason="page faults are counted on Unix")


def page_faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(256 << 20, np.uint8)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told to keep memory")
def test_memory_is_kept_only_in_a_block():
    every_page = page_faults()  # 128, or 65,536 where there are no huge pages
    with KeptMemory():
        with KeptMemory():
            page_faults()
        assert page_faults() < every_page / 8  # the outer block keeps it
    assert page_faults() > every_page / 8
