"""Files of the community, byte for byte: each is opened right, or refused with its sentence."""

from pathlib import Path

import pytest

from gscompleter import InputError, load_splat
from gscompleter.data.formats import open_photographs

OPENED = {
    "colmap_bonsai": (3, 1188.1, 699),
    "colmap_bonsai/images.bin": (3, 1188.1, 699),
    "dgp_ddad": (9, 2167.7, 1936),
    "dgp_ddad/scene.json": (9, 2167.7, 1936),
    "nerfstudio_fox": (67, None, 1080),
    "nerfstudio_fox/transforms.json": (67, None, 1080),
    "re10k/000000.torch": (93, None, 640),
    "waymo_mmdet3d/waymo_infos_val.pkl": (1, 2059.0, 1920),
    "colmap_bonsai/DSCF5574.JPG": (1, None, 699),
    "colmap_bonsai/DSCF5575.JPG": (1, None, 699),
    "colmap_bonsai/DSCF5597.JPG": (1, None, 699),
    "gaussians/playbot_sog/means_l.webp": (1, None, 92),
    "gaussians/playbot_sog/means_u.webp": (1, None, 92),
    "gaussians/playbot_sog/quats.webp": (1, None, 92),
    "gaussians/playbot_sog/scales.webp": (1, None, 92),
    "gaussians/playbot_sog/sh0.webp": (1, None, 92),
    "gaussians/playbot_sog/shN_centroids.webp": (1, None, 512),
    "gaussians/playbot_sog/shN_labels.webp": (1, None, 92),
    "waymo_mmdet3d/0000000.png": (1, None, 1920),
}
"""Number of frames, focal length of the first one (None with distortion), and its width."""

NOTHING = "There are no posed photographs in"
NO_FRAMES = "lists no frames"
REFUSED = {
    "colmap_bonsai/cameras.bin": NOTHING,
    "colmap_bonsai/points3D.bin": NOTHING,
    "dgp_ddad/calibration.json": NO_FRAMES,
    "evaluation_index/dl3dv_start_0_distance_10_ctx_2v_tgt_4v.json": NO_FRAMES,
    "evaluation_index/evaluation_index_acid.json": NO_FRAMES,
    "evaluation_index/evaluation_index_re10k.json": NO_FRAMES,
    "gaussians/arkit_scene.splat": NOTHING,
    "gaussians/biker.compressed.ply": NOTHING,
    "gaussians/biker.spz": NOTHING,
    "gaussians/guitar.compressed.ply": NOTHING,
    "gaussians/guitar.from-compressed.ply": NOTHING,
    "gaussians/minimal/minimal-raw.spz": NOTHING,
    "gaussians/minimal/minimal-v2.spz": NOTHING,
    "gaussians/minimal/minimal-v3.spz": NOTHING,
    "gaussians/minimal/minimal-v4.spz": NOTHING,
    "gaussians/minimal/minimal.ksplat": NOTHING,
    "gaussians/minimal/minimal.splat": NOTHING,
    "gaussians/playbot_lod4.from-sog.ply": NOTHING,
    "gaussians/playbot_sog": NOTHING,
    "gaussians/playbot_sog/meta.json": NO_FRAMES,
    "gsplat_garden/test_garden.npz": NOTHING,
    "idr_dtu/cameras_sphere.npz": NOTHING,
    "kitti/odometry00_poses_first200.txt": "calib.txt cannot be read",
    "kitti/raw_calib_cam_to_cam.partial.txt": NOTHING,
    "kitti/raw_calib_velo_to_cam.txt": NOTHING,
    "kitti/seq1_calib.txt": NOTHING,
    "kitti/seq1_poses.txt": "calib.txt cannot be read",
    "lfs_pointers/point_cloud.ply": NOTHING,
    "lfs_pointers/splat.ply": NOTHING,
    "llff": NOTHING,
    "llff/gnomes_poses_bounds.npy": "has 103 rows, one per photograph",
    "llff/liberty_poses_bounds.npy": "has 135 rows, one per photograph",
    "NOTES.md": NOTHING,
    "nuscenes_mmdet3d/info.pkl": "size of the photograph of CAM_FRONT at .* is not known",
    "re10k/0d4de33c6888a754.head.txt": "size of frame 0 of .* is not known",
}

SPLATS = {
    "gaussians/arkit_scene.splat": (116_906, 0, (1.44, 0.88, -5.86)),
    "gaussians/biker.compressed.ply": (152_746, 0, (-0.06, -1.64, 0.03)),
    "gaussians/biker.spz": (152_746, 0, (-0.06, -1.64, 0.03)),
    "gaussians/guitar.compressed.ply": (90_854, 0, (0.29, -1.13, 0.18)),
    "gaussians/guitar.from-compressed.ply": (90_854, 0, (0.29, -1.13, 0.18)),
    "gaussians/minimal/minimal-raw.spz": (4, 0, (-1.0, 0.0, 0.0)),
    "gaussians/minimal/minimal-v2.spz": (4, 0, (-1.0, 0.0, 0.0)),
    "gaussians/minimal/minimal-v3.spz": (4, 0, (-1.0, 0.0, -1.0)),
    "gaussians/minimal/minimal-v4.spz": (4, 0, (-1.0, 0.0, -1.0)),
    "gaussians/minimal/minimal.ksplat": (4, 0, (-1.0, 0.0, -1.0)),
    "gaussians/minimal/minimal.splat": (4, 0, (-1.0, 0.0, -1.0)),
    "gaussians/playbot_lod4.from-sog.ply": (8_406, 2, (-0.01, -0.02, -0.02)),
    "gaussians/playbot_sog": (8_406, 2, (-0.01, -0.02, -0.02)),
    "gaussians/playbot_sog/meta.json": (8_406, 2, (-0.01, -0.02, -0.02)),
}
"""Number of Gaussians, SH degree, and medians of the means."""

UNKNOWN = "holds no Gaussians in a format that is known"
OTHER_JSON = "is a JSON file without Gaussians"
ARRAYS = "holds arrays of NumPy, no splat"
CHUNK = "is a checkpoint of a trainer or a network"
POINTER = "is a git-lfs pointer, not the file itself; run `git lfs pull`"
NO_SPLATS = {
    "dgp_ddad/calibration.json": OTHER_JSON,
    "dgp_ddad/scene.json": OTHER_JSON,
    "evaluation_index/dl3dv_start_0_distance_10_ctx_2v_tgt_4v.json": OTHER_JSON,
    "evaluation_index/evaluation_index_acid.json": OTHER_JSON,
    "evaluation_index/evaluation_index_re10k.json": OTHER_JSON,
    "gsplat_garden/test_garden.npz": ARRAYS,
    "idr_dtu/cameras_sphere.npz": ARRAYS,
    "lfs_pointers/point_cloud.ply": POINTER,
    "lfs_pointers/splat.ply": POINTER,
    "nerfstudio_fox/transforms.json": OTHER_JSON,
    "re10k/000000.torch": CHUNK,
}
"""Errors of files without Gaussians; those in neither table raise `UNKNOWN`."""


def place(shared: Path, name: str) -> Path:
    path = shared / "formats" / name
    if not path.exists():
        pytest.skip(f"needs {path}")
    return path


@pytest.mark.parametrize("name", OPENED)
def test_a_file_is_opened(shared, name):
    photographs = open_photographs(place(shared, name))
    count, focal, width = OPENED[name]
    camera = photographs.camera(0)
    assert (len(photographs), camera.width) == (count, width)
    assert focal is None or camera.K[0, 0].item() == pytest.approx(focal, abs=0.1)


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_is_refused_with_its_sentence(shared, name):
    with pytest.raises(InputError, match=REFUSED[name]) as error:
        open_photographs(place(shared, name)).camera(0)
    assert "\n" not in str(error.value)


def test_every_file_has_a_row(shared):
    folder = shared / "formats"
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert files <= set(OPENED) | set(REFUSED)


@pytest.mark.parametrize("name", SPLATS)
def test_a_file_of_gaussians_is_opened(shared, name):
    count, degree, medians = SPLATS[name]
    gaussians = load_splat(place(shared, name))
    assert (len(gaussians), gaussians.sh_degree) == (count, degree)
    assert gaussians.means.median(0).values.tolist() == pytest.approx(medians, abs=0.006)


@pytest.mark.parametrize("name", sorted({*OPENED, *REFUSED} - {*SPLATS}))
def test_any_other_file_is_refused_as_gaussians_with_its_sentence(shared, name):
    path = place(shared, name)
    sentence = "is a folder without a splat" if path.is_dir() else NO_SPLATS.get(name, UNKNOWN)
    with pytest.raises(InputError, match=sentence) as error:
        load_splat(path)
    assert "\n" not in str(error.value)
