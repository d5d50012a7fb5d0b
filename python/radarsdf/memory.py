"""Available memory, and errors for meshes and views that need more."""

from pathlib import Path

# Bytes for a view of a map: peaks of maps of 1e5 to 2e5 leaf cells.
_PER_CELL_TRACED = 300.0  # surface for ray casting, built once per map
_PER_PATCH_SEEN = 100.0
_PER_BEAM = 100.0


def check_views(max_memory_bytes: int | None, *, cells: int = 0, patches: int = 0, beams: int = 0) -> None:
    """Raise a MemoryError for too large views: `cells` of a map whose surface is not yet built, `patches` of it, `beams` of a view."""
    needed = cells * _PER_CELL_TRACED + patches * _PER_PATCH_SEEN + beams * _PER_BEAM
    check_memory("these views", needed, max_memory_bytes, "use fewer poses or returns, or fit fewer scans")


def check_memory(what: str, needed_bytes: float, max_memory_bytes: int | None, remedy: str) -> None:
    """Raise a MemoryError if `what` needs more than the limit; None: than is available."""
    available = available_bytes() if max_memory_bytes is None else max_memory_bytes
    if available is not None and needed_bytes > available:
        msg = f"{what} would take about {needed_bytes / 1e9:.2f} GB, of {available / 1e9:.2f}: {remedy}"
        raise MemoryError(msg)


def available_bytes(root: Path = Path("/")) -> int | None:
    """Memory that this process can still allocate, bytes: the minimum over the system and its control group.

    None if it is unknown, as on systems other than Linux. `root` is the root of the file system, for tests.
    """
    try:
        lines = (root / "proc/meminfo").read_text().splitlines()
        available = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
        _, _, group = (root / "proc/self/cgroup").read_text().partition("0::")
    except (OSError, StopIteration):
        return None
    top = root / "sys/fs/cgroup"
    for folder in (top, top / group.strip().lstrip("/")):  # a container sees its own group at the top
        try:
            left = int((folder / "memory.max").read_text()) - int((folder / "memory.current").read_text())
            stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        except (OSError, ValueError):  # no such group, or its limit is "max"
            continue
        left += int(stat.get("inactive_file", 0))  # page cache, which the system can drop
        available = min(available, max(0, left))
    return available
