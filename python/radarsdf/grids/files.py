"""File formats of grids: OctoMap's binary octree, OpenVDB, and ROS's map_server (YAML and PGM)."""

import struct
import zlib
from pathlib import Path
from uuid import UUID

import numpy as np

from radarsdf.arrays import Array, Bools, Floats, Floats32, Ints, NDArray
from radarsdf.checks import check
from radarsdf.core import cell_keys
from radarsdf.io.files import check_outputs, checked_suffix, write_whole

_PIXELS = np.array([254, 0, 205], np.uint8)  # grey values of map_saver for free, occupied and unknown
_LEVELS = 16  # depth of OctoMap's octree
_HALF = 1 << (_LEVELS - 1)  # half width of the tree, voxels
_MOST_OFF = 0.01  # tolerance for rounding of the origin, voxels
_FREE, _OCCUPIED, _INNER = 1, 2, 3
_ZIP = 1  # compression of OpenVDB


def write_map_server(path: Path, state: NDArray[np.int8], origin: Floats, cell_m: float) -> None:
    """Write states (X, Y) from `origin` (2,), m, as ``NAME.yaml``, which is `path`, and ``NAME.pgm``."""
    checked_suffix(path, (".yaml",), "map_server")
    image = path.with_suffix(".pgm")
    check_outputs([path, image])
    rows = np.ascontiguousarray(_PIXELS[state].T[::-1])  # image rows are in descending order of y
    header = f"P5\n{rows.shape[1]} {rows.shape[0]}\n255\n".encode()
    write_whole(image, header + rows.tobytes())
    quoted = image.name.replace("'", "''")
    text = (
        f"image: '{quoted}'\nmode: trinary\nresolution: {cell_m:.9g}\n"
        f"origin: [{origin[0]:.9f}, {origin[1]:.9f}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    write_whole(path, text.encode())


def write_octomap(path: Path, state: NDArray[np.int8], origin: Floats, voxel_m: float) -> None:
    """Write states (X, Y, Z) from `origin` (3,), m, a multiple of the voxel, as OctoMap's binary octree."""
    start = np.round(origin / voxel_m)
    even = np.abs(origin / voxel_m - start).max() <= _MOST_OFF
    wanted = f"a multiple of its voxels of {voxel_m:g} m, as OctoMap's are"
    check(even, f"the grid's origin, {origin}, must be {wanted}: the nearest is {start * voxel_m}")
    known = state >= 0
    keys = np.argwhere(known) + start.astype(np.int64) + _HALF
    inside = ((keys >= 0) & (keys < 2 * _HALF)).all()
    check(inside, f"the grid is beyond the end of OctoMap's octree, {_HALF} voxels from the world's origin")
    size, data = _octree(keys, np.where(state[known] == 1, _OCCUPIED, _FREE))
    header = (
        "# Octomap OcTree binary file\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
        f"id OcTree\nsize {size}\nres {voxel_m:.9g}\ndata\n"
    )
    write_whole(path, header.encode() + data)


def _octree(keys: Ints, codes: Ints) -> tuple[int, bytes]:
    """Encode voxels (N, 3) with codes (N,): number of nodes, and two bytes for each inner node in depth-first order."""
    # The two bytes are the codes of its eight children, x varying fastest; 0: unknown.
    numbers = cell_keys(np.ascontiguousarray(keys + 0.5), 1.0).astype(np.int64)  # Morton codes
    numbers &= (1 << 3 * _LEVELS) - 1  # of the levels
    size, firsts, levels, words = int(len(keys) > 0), [], [], []
    for level in range(1, _LEVELS + 1):
        parents, where = np.unique(numbers >> 3, return_inverse=True)
        word = np.zeros(len(parents), np.int64)
        np.bitwise_or.at(word, where, codes << (2 * (numbers & 7)))
        # Prune eight children that are all free, or all occupied, to a leaf.
        is_leaf = (word == 0x5555) | (word == 0xAAAA)
        size += int(np.count_nonzero(~is_leaf[where]))
        firsts.append(parents[~is_leaf] << (3 * level))
        levels.append(np.full(len(firsts[-1]), -level))
        words.append(word[~is_leaf])
        numbers, codes = parents, np.where(is_leaf, word & 3, _INNER)
    # Pre-order: sort by the number of the first voxel, larger nodes first.
    order = np.lexsort([np.concatenate(levels), np.concatenate(firsts)])
    return size, np.concatenate(words)[order].astype("<u2").tobytes()


def write_vdb(path: Path, values: Floats32, known: Bools, origin: Floats, voxel_m: float) -> None:
    """Write values (X, Y, Z) of known voxels as an OpenVDB level set named `distance`; the largest value is the background."""
    scales = (voxel_m, voxel_m, 1 / voxel_m, 1 / voxel_m**2, 0.5 / voxel_m)
    # OpenVDB's voxels are points: the centres of ours.
    transform = np.array([*(origin + 0.5 * voxel_m), *np.repeat(scales, 3)], "<f8").tobytes()
    words = ("class", "string", "level set", "name", "string", "distance", "UniformScaleTranslateMap")
    grid = struct.pack("<II", _ZIP, 2) + b"".join(map(_vdb_text, words)) + transform
    topology, leaves = _vdb_tree(values, known, np.float32(values[known].max(initial=0.0)))
    header = b" BDV" + struct.pack("<iIII?36sII", 0, 224, 10, 0, True, str(UUID(int=0)).encode(), 0, 1)
    header += b"".join(map(_vdb_text, ("distance", "Tree_float_5_4_3", "")))
    offsets = np.cumsum([len(header) + 24, len(grid) + len(topology), len(leaves)]).astype("<i8")
    write_whole(path, header + offsets.tobytes() + grid + topology + leaves)


def _vdb_tree(values: Floats32, known: Bools, background: np.float32) -> tuple[bytes, bytes]:
    """Encode OpenVDB's tree: its nodes of 4096³, 128³ and 8³ voxels, depth first, and the values of the latter."""

    def leaves(array: Array, at: tuple[int, ...]) -> Array:
        """Return the voxels (4096, 512) of a node of 128³, by leaf."""
        part = array[tuple(slice(128 * a, 128 * (a + 1)) for a in at)]
        part = np.pad(part, [(0, 128 - size) for size in part.shape])
        return part.reshape(16, 8, 16, 8, 16, 8).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 512)

    def node(children: Bools) -> bytes:
        masks = np.packbits(children, bitorder="little").tobytes() + bytes(len(children) // 8)
        return masks + _vdb_values(np.full(len(children), background))

    roots: dict[tuple[int, ...], tuple[Bools, list[bytes]]] = {}
    buffers = []
    nodes = np.ndindex(*(-(-size // 128) for size in values.shape))
    for at in sorted(nodes, key=lambda at: [a // 32 for a in at]):
        active = leaves(known, at)
        used = np.asarray(active.any(axis=1))
        if used.any():
            children, below = roots.setdefault(tuple(a // 32 for a in at), (np.zeros(32**3, bool), []))
            children[np.ravel_multi_index([a % 32 for a in at], (32, 32, 32))] = True
            masks = np.packbits(active[used], axis=1, bitorder="little")
            below.append(node(used) + masks.tobytes())
            numbers = np.where(active, leaves(values, at), background)[used]
            buffers += [mask.tobytes() + _vdb_values(leaf) for mask, leaf in zip(masks, numbers, strict=True)]
    parts = [struct.pack("<IfII", 1, background, 0, len(roots))]
    for root, (children, below) in roots.items():
        parts += [(4096 * np.array(root)).astype("<i4").tobytes(), node(children), *below]
    return b"".join(parts), b"".join(buffers)


def _vdb_values(values: Floats32) -> bytes:
    packed = zlib.compress(values.astype("<f4").tobytes())
    return b"\x06" + struct.pack("<q", len(packed)) + packed  # all values, not only those that differ


def _vdb_text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()
