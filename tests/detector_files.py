"""People as the files that other detectors write: their names, order, units and axes."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from hiros_mcap.io.detectors.body_models import body_model, joints_of
from hiros_mcap.io.log import open_log

CAMERA = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rows: x right, y down, z ahead, for somebody who looks along the room's y axis."""
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
POSE2SIM = (
    *("RHip", "RKnee", "RAnkle", "RBigToe", "LHip", "LKnee", "LAnkle", "LBigToe", "Neck", "Head"),
    *("Nose", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist"),
)
OPENCAP = (
    *("Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist", "midHip"),
    *("RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", "LBigToe", "RBigToe"),
)
MOTIVE = {
    **{"Hip": "PELVIS", "Ab": "SPINE_NAVAL", "Chest": "SPINE_CHEST", "Neck": "NECK"},
    **{"Head": "HEAD", "LShoulder": "CLAVICLE_LEFT", "LUArm": "SHOULDER_LEFT"},
    **{"LFArm": "ELBOW_LEFT", "LHand": "WRIST_LEFT", "RShoulder": "CLAVICLE_RIGHT"},
    **{"RUArm": "SHOULDER_RIGHT", "RFArm": "ELBOW_RIGHT", "RHand": "WRIST_RIGHT"},
    **{"LThigh": "HIP_LEFT", "LShin": "KNEE_LEFT", "LFoot": "ANKLE_LEFT", "LToe": "FOOT_LEFT"},
    **{"RThigh": "HIP_RIGHT", "RShin": "KNEE_RIGHT", "RFoot": "ANKLE_RIGHT", "RToe": "FOOT_RIGHT"},
}
"""Bone -> the joint where it begins."""


def truth_of(log):
    """Frames of the true people of a log, and the names of their markers."""
    with open_log(log, topics=["/truth/*"]) as opened:
        return list(opened.frames()), opened.model.marker_names


def seen(frame, markers, names):
    """(P, K, 3) joints of these names, m, z up; NaN for those that the frame lacks."""
    slots = {joint: slot for slot, joint in enumerate(joints_of(markers))}
    found = np.full((frame.n_people, len(names), 3), np.nan)
    for k, (part, side) in enumerate(joints_of(names)):
        slot = slots.get(("foot" if part == "bigtoe" else part, side))
        if slot is not None:
            found[:, k] = frame.positions[:, slot]
    return found


def openpose(folder, frames, markers):
    """``--3d --write_json``: a file per instant; a joint that was not triangulated is 0 0 0 0."""
    folder.mkdir()
    for number, frame in enumerate(frames):
        people = []
        for person in seen(frame, markers, body_model("openpose-25").marker_names) @ CAMERA.T:
            rows = np.column_stack([person, np.ones(len(person))])
            rows[np.isnan(person).any(axis=1)] = 0.0
            hands: dict[str, Any] = {
                f"{part}_keypoints_3d": [] for part in ("face", "hand_left", "hand_right")
            }
            flat: dict[str, Any] = {"person_id": [-1], "pose_keypoints_2d": []}
            people.append(flat | {"pose_keypoints_3d": rows.ravel().tolist()} | hands)
        path = folder / f"walk_{number:012d}_keypoints.json"
        path.write_text(json.dumps({"version": 1.3, "people": people}))


def mediapipe(path, frames, markers):
    """``PoseLandmarkerResult`` of each image: 33 landmarks from the middle of the hips."""
    instants = []
    for number, frame in enumerate(frames):
        people = seen(frame, markers, body_model("mediapipe-33").marker_names) @ CAMERA.T
        people -= people[:, 23:25].mean(axis=1, keepdims=True)
        marks = [
            [
                {"x": x, "y": y, "z": z, "visibility": 0.9, "presence": 0.9, "name": None}
                for x, y, z in np.nan_to_num(person).tolist()
            ]
            for person in people
        ]
        image = [[mark | {"x": 0.5, "y": 0.5} for mark in person] for person in marks]
        instants.append(
            {
                "timestamp_ms": round(number * 1000 / 30),
                "pose_landmarks": image,
                "pose_world_landmarks": marks,
            }
        )
    path.write_text(json.dumps(instants))


def freemocap(path, frames, markers):
    """``mediapipe_body_3d_xyz.csv``: mm, z up, no times."""
    names = body_model("mediapipe-33").marker_names
    lines = [",".join(f"body_{name}_{axis}" for name in names for axis in "xyz")]
    for frame in frames:
        row = (1000 * seen(frame, markers, names)[0]).ravel()
        lines.append(",".join("" if np.isnan(v) else repr(float(v)) for v in row))
    path.write_text("\n".join(lines) + "\n")


def body_of(frame, markers):
    """(33, 3) mm of the first person, as MediaPipe's landmarks."""
    return 1000 * seen(frame, markers, body_model("mediapipe-33").marker_names)[0]


def freemocap_by_frame(path, frames, markers, version):
    """``NAME_by_frame.csv`` of version 1, ``freemocap_data_by_frame.csv`` of 2: a row per joint."""
    dot = "." if version == 2 else "_"
    more = ",trajectory" if version == 2 else ",timestamp,timestamp_by_camera"
    lines = [f"frame,model,keypoint,x,y,z{more}"]
    for number, frame in enumerate(frames):
        for name, xyz in zip(
            body_model("mediapipe-33").marker_names, body_of(frame, markers), strict=True
        ):
            cells = ",".join("" if np.isnan(v) else repr(float(v)) for v in xyz)
            tail = ",3d_xyz" if version == 2 else ",,{}"
            lines.append(f"{number},mediapipe{dot}body,{name},{cells}{tail}")
        lines.append(f"{number},mediapipe{dot}face,0001,1,2,3{tail}")
        if version == 2:
            lines.append(f"{number},mediapipe.body,nose,9,9,9,rigid_3d_xyz")
    path.write_text("\n".join(lines) + "\n")


def freemocap_by_trajectory(path, frames, markers):
    """``NAME_by_trajectory.csv``: the times, the body, a hand and centres of mass."""
    names = [f"body_{name}" for name in body_model("mediapipe-33").marker_names]
    names += ["com_full_body", "left_hand_0000"]
    head = ["timestamp", "timestamp_by_camera", *(f"{n}_{axis}" for n in names for axis in "xyz")]
    lines = [",".join(head)]
    for number, frame in enumerate(frames):
        row = [*body_of(frame, markers).ravel(), *[1.0] * 6]
        cells = ",".join("" if np.isnan(v) else repr(float(v)) for v in row)
        lines.append(f'{number / 30!r},"{{0: 1.5, 1: 1.6}}",{cells}')
    path.write_text("\n".join(lines) + "\n")


def freemocap_npy(path, frames, markers):
    """``mediaPipeSkel_3d_body_hands_face.npy``: the body, then 520 other points."""
    body = np.stack([body_of(frame, markers) for frame in frames])
    np.save(path, np.concatenate([body, np.ones((len(frames), 520, 3))], axis=1))


def azure_kinect(path, frames, markers):
    """``offline_processor``: us, mm, x right, y down, z ahead."""
    names = body_model("azure-kinect").marker_names
    content = [
        {
            "timestamp_usec": round(number * 1e6 / 30),
            "frame_id": number,
            "num_bodies": frame.n_people,
            "bodies": [
                {"body_id": k + 1, "joint_positions": (1000 * person).tolist()}
                | {"joint_orientations": [[1.0, 0, 0, 0]] * len(names)}
                for k, person in enumerate(seen(frame, markers, names) @ CAMERA.T)
            ],
        }
        for number, frame in enumerate(frames)
    ]
    path.write_text(json.dumps({"joint_names": names, "bone_list": [], "frames": content}))


def zed(path, frames, markers, n_keypoints=18):
    """The SDK's sample of a JSON export: instants by their time, m, confidences to 100."""
    names = body_model(f"zed-{n_keypoints}").marker_names
    instants = {}
    for number, frame in enumerate(frames):
        stamp = 1_700_000_000_000_000_000 + round(number * 1e9 / 30)
        people = [
            {
                "id": k,
                "confidence": 80.0,
                "position": person[0].tolist(),
                "keypoint": person.tolist(),
                "keypoint_confidence": [90.0] * len(names),
            }
            for k, person in enumerate(seen(frame, markers, names) @ CAMERA.T)
        ]
        instants[str(stamp // 10**6)] = {"is_new": True, "timestamp": stamp, "body_list": people}
    path.write_text(json.dumps(instants))


def trc_text(positions, names, times, unit="m"):
    """A plain TRC file of (T, M, 3) positions at some times, s."""
    rate = round(1 / np.diff(times).mean())
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tx.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        f"{rate}\t{rate}\t{len(positions)}\t{len(names)}\t{unit}",
        "Frame#\tTime\t" + "\t\t\t".join(names),
        "",
    ]
    for k, (time, row) in enumerate(zip(times, positions, strict=True)):
        lines.append(f"{k}\t{time:.9f}\t" + "\t".join(map(repr, np.ravel(row).tolist())))
    return "\n".join([*lines, ""])


def trc(path, frames, markers, names, person):
    """A TRC file as Pose2Sim and OpenCap write it: m, y up, one person."""
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame"
        "\tOrigNumFrames",
        f"30\t30\t{len(frames)}\t{len(names)}\tm\t30\t0\t{len(frames)}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t\t",
        "\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(names)) for axis in "XYZ"),
    ]
    for number, frame in enumerate(frames):
        row = (seen(frame, markers, names)[person] @ Y_UP.T).ravel().tolist()
        head.append(f"{number + 1}\t{number / 30!r}\t" + "\t".join(map(repr, row)))
    path.write_text("\n".join(head) + "\n")


def motive_text(points, names, times, kind, head, id_lines=2):
    """A CSV file of Motive: (T, M, 3) points of a kind, beside rotations, a rigid body, a marker.

    Since 1.25, a line of parents is below that of the IDs.
    """
    columns = [("Rigid Body", "Box", "Position", *"XYZ")]
    columns += [("Rigid Body Marker", "Box:Marker1", "Position", *"XYZ")]
    columns += [("Marker", "Unlabeled 12", "Position", *"XYZ")]
    columns += [(kind, name, "Rotation", *"XYZW") for name in names]
    columns += [(kind, name, "Position", *"XYZ") for name in names]
    lines = [f"Format Version,1.23,Take Name,walk,{head}", ""]
    for title, place in (("Type", 0), ("Name", 1), *[("ID", 1)] * id_lines, ("", 2)):
        lines.append(",".join(["", title, *(f'"{c[place]}"' for c in columns for _ in c[3:])]))
    lines.append(",".join(["Frame", "Time (Seconds)", *(axis for c in columns for axis in c[3:])]))
    others = ["9"] * (9 + 4 * len(names))
    for k, (time, row) in enumerate(zip(times, points, strict=True)):
        cells = ["" if np.isnan(v) else repr(v) for v in np.ravel(row).tolist()]
        lines.append(",".join([str(k), repr(float(time)), *others, *cells]))
    return "\n".join([*lines, ""])


def motive(path, frames, markers):
    """The bones of Anna and Ben: mm, y up."""
    people = np.stack([seen(frame, markers, [*MOTIVE.values()])[:2] @ Y_UP.T for frame in frames])
    names = [f"{person}:{bone}" for person in ("Anna", "Ben") for bone in MOTIVE]
    times = np.arange(len(frames)) / 30
    points = 1000 * people.reshape(len(frames), -1, 3)
    path.write_text(motive_text(points, names, times, "Bone", "Length Units,Millimeters"))


def write_all(folder, log):
    """Write what docs/detectors.md imports, of the true people of a log of two."""
    frames, markers = truth_of(log)
    openpose(folder / "openpose", frames, markers)
    mediapipe(folder / "mediapipe.json", frames, markers)
    freemocap(folder / "mediapipe_body_3d_xyz.csv", frames, markers)
    freemocap_by_frame(folder / "lab_by_frame.csv", frames, markers, 1)
    freemocap_by_frame(folder / "freemocap_data_by_frame.csv", frames, markers, 2)
    freemocap_by_trajectory(folder / "lab_by_trajectory.csv", frames, markers)
    freemocap_npy(folder / "mediaPipeSkel_3d_body_hands_face.npy", frames, markers)
    for camera in ("front", "side"):
        azure_kinect(folder / f"{camera}.json", frames, markers)
        zed(folder / f"zed_{camera}.json", frames, markers)
    for person in (0, 1):
        trc(folder / f"walk_P{person + 1}.trc", frames, markers, POSE2SIM, person)
    trc(folder / "squat.trc", frames, markers, OPENCAP, 0)
    motive(folder / "take.csv", frames, markers)
