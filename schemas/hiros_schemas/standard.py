"""Messages of other packages that hiros reads or writes, by type name; ROS 2's own as of Humble."""

STANDARD = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": ("geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"),
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/Accel": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec\n",
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\n"
        "float64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    ),
    "rcl_interfaces/Log": (
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\n"
        "string file\nstring function\nuint32 line\n"
    ),
    "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v\n",
    "visualization_msgs/MeshFile": "string filename\nuint8[] data\n",
    "visualization_msgs/Marker": (
        "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\n"
        "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\n"
        "builtin_interfaces/Duration lifetime\nbool frame_locked\ngeometry_msgs/Point[] points\n"
        "std_msgs/ColorRGBA[] colors\nstring texture_resource\n"
        "sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\n"
        "string text\nstring mesh_resource\nvisualization_msgs/MeshFile mesh_file\n"
        "bool mesh_use_embedded_materials\n"
    ),
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers\n",
    # Stereolabs' package zed_msgs, as documented for the ZED ROS 2 wrapper 5.
    "zed_msgs/Keypoint2Di": "uint32[2] kp\n",
    "zed_msgs/Keypoint2Df": "float32[2] kp\n",
    "zed_msgs/Keypoint3D": "float32[3] kp\n",
    "zed_msgs/BoundingBox2Di": "zed_msgs/Keypoint2Di[4] corners\n",
    "zed_msgs/BoundingBox2Df": "zed_msgs/Keypoint2Df[4] corners\n",
    "zed_msgs/BoundingBox3D": "zed_msgs/Keypoint3D[8] corners\n",
    "zed_msgs/Skeleton2D": "zed_msgs/Keypoint2Df[70] keypoints\n",
    "zed_msgs/Skeleton3D": "zed_msgs/Keypoint3D[70] keypoints\n",
    "zed_msgs/Object": (
        "string label\nint16 label_id\nstring sublabel\nfloat32 confidence\n"
        "float32[3] position\nfloat32[6] position_covariance\nfloat32[3] velocity\n"
        "bool tracking_available\nint8 tracking_state\nint8 action_state\n"
        "zed_msgs/BoundingBox2Di bounding_box_2d\nzed_msgs/BoundingBox3D bounding_box_3d\n"
        "float32[3] dimensions_3d\nbool skeleton_available\nint8 body_format\n"
        "zed_msgs/BoundingBox2Df head_bounding_box_2d\n"
        "zed_msgs/BoundingBox3D head_bounding_box_3d\nfloat32[3] head_position\n"
        "zed_msgs/Skeleton2D skeleton_2d\nzed_msgs/Skeleton3D skeleton_3d\n"
    ),
    "zed_msgs/ObjectsStamped": "std_msgs/Header header\nzed_msgs/Object[] objects\n",
}
