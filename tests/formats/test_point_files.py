import numpy as np
import pytest

from lcf3d.errors import DatasetError, FormatError
from lcf3d.formats.point_files import column_count, read_scan

POINTS = np.array([[1, 2, 3, 0.5], [-4, 5, -1.25, 0.25], [30, 0, 0, 1]], dtype=np.float32)


def test_bin_with_named_columns(tmp_path):
    table = np.column_stack([np.arange(3), POINTS[:, [3, 0, 1, 2]]]).astype("<f4")
    table.tofile(tmp_path / "a.bin")
    assert np.array_equal(read_scan(tmp_path / "a.bin", ("ring", "intensity", "x", "y", "z")), POINTS)
    with pytest.raises(FormatError, match="cut off, or its columns are others than x, y, z, intensity"):
        read_scan(tmp_path / "a.bin")
    with pytest.raises(FormatError, match="has no column z"):
        read_scan(tmp_path / "a.bin", ("x", "y", "c", "d", "e"))


def test_npy_with_and_without_names(tmp_path):
    np.save(tmp_path / "a.npy", POINTS[:, :3])
    assert np.array_equal(read_scan(tmp_path / "a.npy")[:, 3], np.zeros(3))
    named = np.zeros(3, dtype=[("Reflectance", "f8"), ("x", "f8"), ("y", "f8"), ("z", "f8")])
    for name, column in zip(("x", "y", "z", "Reflectance"), POINTS.T, strict=True):
        named[name] = column
    np.save(tmp_path / "b.npy", named)
    assert np.array_equal(read_scan(tmp_path / "b.npy"), POINTS)
    np.save(tmp_path / "c.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(FormatError, match="cannot be read as a NumPy array"):
        read_scan(tmp_path / "c.npy")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply(tmp_path, form):
    lines = ["ply", f"format {form} 1.0", "element vertex 3"]
    lines += [f"property {t} {n}" for t, n in (("double", "x"), ("float", "y"), ("float", "z"), ("uchar", "intensity"))]
    head = "\n".join([*lines, "element face 0", "property list uchar int vertex_indices", "end_header\n"]).encode()
    order = ">" if "big" in form else "<"
    table = np.zeros(3, dtype=[("x", order + "f8"), ("y", order + "f4"), ("z", order + "f4"), ("i", "u1")])
    for name, column in zip("xyzi", POINTS.T * [[1], [1], [1], [4]], strict=True):
        table[name] = column
    body = table.tobytes() if form != "ascii" else b"".join(b"%g %g %g %d\n" % tuple(row) for row in table.tolist())
    (tmp_path / "a.ply").write_bytes(head + body)
    assert np.array_equal(read_scan(tmp_path / "a.ply"), POINTS * [1, 1, 1, 4])
    (tmp_path / "a.ply").write_bytes(head + body[:-4])
    if form != "ascii":
        with pytest.raises(FormatError, match="cut off"):
            read_scan(tmp_path / "a.ply")


def test_pcd_of_missing_returns_and_missing_fields(tmp_path):
    pypcd4 = pytest.importorskip("pypcd4")
    with_missing = np.vstack([POINTS, [np.nan, np.nan, np.nan, 0]]).astype(np.float32)
    for encoding in pypcd4.Encoding:
        cloud = pypcd4.PointCloud.from_xyzi_points(with_missing)
        cloud.save(tmp_path / "a.pcd", encoding=encoding)
        assert np.array_equal(read_scan(tmp_path / "a.pcd"), POINTS)
    flat = pypcd4.PointCloud.from_points(POINTS[:, :2], ("x", "y"), (np.float32, np.float32))
    flat.save(tmp_path / "b.pcd")
    with pytest.raises(FormatError, match=r"has no column z; it holds x, y"):
        read_scan(tmp_path / "b.pcd")
    whole = (tmp_path / "a.pcd").read_bytes()
    (tmp_path / "c.pcd").write_bytes(whole[: len(whole) // 3])
    with pytest.raises(FormatError, match="cannot be read as a PCD file"):
        read_scan(tmp_path / "c.pcd")


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las(tmp_path, suffix):
    laspy = pytest.importorskip("laspy")
    cloud = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    cloud.header.scales = [0.001] * 3
    cloud.x, cloud.y, cloud.z = POINTS[:, :3].T
    cloud.intensity = np.round(POINTS[:, 3] * 65535).astype(np.uint16)
    cloud.write(str(tmp_path / f"a{suffix}"))
    assert np.allclose(read_scan(tmp_path / f"a{suffix}"), POINTS, atol=1e-3)
    # billions of records in the header: not one is made
    bomb = bytearray((tmp_path / f"a{suffix}").read_bytes())
    bomb[100:104] = b"\xff" * 4
    (tmp_path / f"bomb{suffix}").write_bytes(bomb)
    with pytest.raises(FormatError, match="counts more records than it holds"):
        read_scan(tmp_path / f"bomb{suffix}")
    (tmp_path / f"b{suffix}").write_bytes(b"LASF")
    with pytest.raises(FormatError, match="cannot be read as a LAS file"):
        read_scan(tmp_path / f"b{suffix}")


def test_numbers_of_another_byte_order_are_not_believed(tmp_path):
    POINTS.astype(">f4").tofile(tmp_path / "a.bin")
    with pytest.raises(FormatError, match="check the columns, their type and the byte order"):
        read_scan(tmp_path / "a.bin")
    with pytest.raises(DatasetError, match="does not exist"):
        read_scan(tmp_path / "b.bin")
    (tmp_path / "c.xyz").write_text("1 2 3")
    with pytest.raises(FormatError, match="no scan of a known kind"):
        read_scan(tmp_path / "c.xyz")


@pytest.mark.parametrize("columns", [4, 5, 6])
def test_columns_of_a_bin_file_are_counted(tmp_path, columns):
    rng = np.random.default_rng(columns)
    angle = np.linspace(0, 20 * np.pi, 6000)
    ring = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), np.full(6000, -1.7)])
    table = np.column_stack([ring, rng.uniform(0, 1, (6000, columns - 3))]).astype("<f4")
    table.tofile(tmp_path / "a.bin")
    assert column_count(tmp_path / "a.bin") == columns
