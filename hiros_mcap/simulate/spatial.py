"""Rotations of many segments at once, by scipy; quaternions are x y z w."""

from __future__ import annotations

from hiros_mcap.skeletons import Floats


def quaternions(matrices: Floats) -> Floats:
    """(..., 4) unit quaternions of rotation matrices (..., 3, 3), largest component positive."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat()
    return flat.reshape(*matrices.shape[:-2], 4)


def from_vector(vectors: Floats) -> Floats:
    """(..., 4) unit quaternions of rotation vectors (..., 3), rad."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_quat()
    return flat.reshape(*vectors.shape[:-1], 4)


def vectors(quaternions: Floats) -> Floats:
    """(..., 3) rotation vectors, rad, of the shorter way round."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_quat(quaternions.reshape(-1, 4)).as_rotvec()
    return flat.reshape(*quaternions.shape[:-1], 3)


def from_euler(sequence: str, angles: Floats) -> Floats:
    """(..., 3, 3) matrices of angles (..., 3), rad, about moving axes, such as "ZXY"."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_euler(sequence, angles.reshape(-1, len(sequence))).as_matrix()
    return flat.reshape(*angles.shape[:-1], 3, 3)
