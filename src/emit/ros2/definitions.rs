//! Definitions of the ROS 2 messages, which a file holds so that any reader can decode them.
//!
//! Sources: `builtin_interfaces` (rcl_interfaces), `std_msgs`, `geometry_msgs`, `sensor_msgs` (common_interfaces), `tf2_msgs` (geometry2), and
//! `marine_acoustic_msgs` 2.1.0 (marine_msgs), whose branches for ROS 1 and ROS 2 agree. Fields and constants are theirs, without their comments.

/// Line between a definition and those of the types in it, as `ros2msg` requires.
const SEPARATOR: &str =
    "================================================================================";

/// Types by name, with their fields.
const TYPES: [(&str, &str); 18] = [
    ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"),
    (
        "std_msgs/Header",
        "builtin_interfaces/Time stamp\nstring frame_id\n",
    ),
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n"),
    (
        "geometry_msgs/Quaternion",
        "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    ),
    (
        "geometry_msgs/Pose",
        "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    ),
    (
        "geometry_msgs/PoseStamped",
        "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    ),
    (
        "geometry_msgs/Transform",
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    ),
    (
        "geometry_msgs/TransformStamped",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
    ),
    (
        "tf2_msgs/TFMessage",
        "geometry_msgs/TransformStamped[] transforms\n",
    ),
    (
        "sensor_msgs/NavSatStatus",
        "int8 STATUS_NO_FIX=-1\nint8 STATUS_FIX=0\nint8 STATUS_SBAS_FIX=1\nint8 STATUS_GBAS_FIX=2\nint8 status\n\
         uint16 SERVICE_GPS=1\nuint16 SERVICE_GLONASS=2\nuint16 SERVICE_COMPASS=4\nuint16 SERVICE_GALILEO=8\nuint16 service\n",
    ),
    (
        "sensor_msgs/NavSatFix",
        "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude\n\
         float64[9] position_covariance\nuint8 COVARIANCE_TYPE_UNKNOWN=0\nuint8 COVARIANCE_TYPE_APPROXIMATED=1\n\
         uint8 COVARIANCE_TYPE_DIAGONAL_KNOWN=2\nuint8 COVARIANCE_TYPE_KNOWN=3\nuint8 position_covariance_type\n",
    ),
    (
        "marine_acoustic_msgs/PingInfo",
        "float32 frequency\nfloat32 sound_speed\nfloat32[] tx_beamwidths\nfloat32[] rx_beamwidths\n",
    ),
    (
        "marine_acoustic_msgs/SonarImageData",
        "bool is_bigendian\nuint32 DTYPE_UINT8=0\nuint32 DTYPE_INT8=1\nuint32 DTYPE_UINT16=2\nuint32 DTYPE_INT16=3\n\
         uint32 DTYPE_UINT32=4\nuint32 DTYPE_INT32=5\nuint32 DTYPE_UINT64=6\nuint32 DTYPE_INT64=7\nuint32 DTYPE_FLOAT32=8\n\
         uint32 DTYPE_FLOAT64=9\nuint32 dtype\nuint32 beam_count\nuint8[] data\n",
    ),
    (
        "marine_acoustic_msgs/DetectionFlag",
        "uint8 DETECT_OK=0\nuint8 DETECT_BAD_SONAR=1\nuint8 DETECT_BAD_FILTER=2\nuint8 DETECT_BAD_USER=4\nuint8 flag\n",
    ),
    (
        "marine_acoustic_msgs/RawSonarImage",
        "std_msgs/Header header\nmarine_acoustic_msgs/PingInfo ping_info\nfloat32 sample_rate\nuint32 samples_per_beam\n\
         uint32 sample0\nfloat32[] tx_delays\nfloat32[] tx_angles\nfloat32[] rx_angles\nmarine_acoustic_msgs/SonarImageData image\n",
    ),
    (
        "marine_acoustic_msgs/ProjectedSonarImage",
        "std_msgs/Header header\nmarine_acoustic_msgs/PingInfo ping_info\ngeometry_msgs/Vector3[] beam_directions\n\
         float32[] ranges\nmarine_acoustic_msgs/SonarImageData image\n",
    ),
    (
        "marine_acoustic_msgs/SonarDetections",
        "std_msgs/Header header\nmarine_acoustic_msgs/PingInfo ping_info\nmarine_acoustic_msgs/DetectionFlag[] flags\n\
         float32[] two_way_travel_times\nfloat32[] tx_delays\nfloat32[] intensities\nfloat32[] tx_angles\nfloat32[] rx_angles\n",
    ),
];

fn fields(name: &str) -> Option<&'static str> {
    let found = TYPES.iter().find(|(of, _)| *of == name);
    found.map(|(_, fields)| *fields)
}

/// The complete definition of a type `package/Name`: its own, and those of all types in it.
pub(super) fn definition(name: &str) -> String {
    let mut needed = vec![name];
    let mut at = 0;
    while let Some(name) = needed.get(at) {
        for line in fields(name).unwrap_or_default().lines() {
            let of = line.split([' ', '[']).next().unwrap_or_default();
            if of.contains('/') && !needed.contains(&of) {
                needed.push(of);
            }
        }
        at += 1;
    }
    let mut text = fields(name).unwrap_or_default().to_owned();
    for name in &needed[1..] {
        let fields = fields(name).unwrap_or_default();
        text += &format!("{SEPARATOR}\nMSG: {name}\n{fields}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_definition_holds_every_type_in_it_once() {
        let text = definition("tf2_msgs/TFMessage");
        for name in [
            "geometry_msgs/TransformStamped",
            "std_msgs/Header",
            "builtin_interfaces/Time",
            "geometry_msgs/Transform",
            "geometry_msgs/Vector3",
            "geometry_msgs/Quaternion",
        ] {
            assert_eq!(text.matches(&format!("MSG: {name}\n")).count(), 1, "{name}");
        }
        assert_eq!(text.matches("MSG: ").count(), 6);
        assert!(text.starts_with("geometry_msgs/TransformStamped[] transforms\n"));
        // Every type that a field names is defined.
        for (name, fields) in TYPES {
            for line in fields.lines() {
                let of = line.split([' ', '[']).next().expect("a type");
                assert!(
                    !of.contains('/') || super::fields(of).is_some(),
                    "{name}: {line}"
                );
            }
        }
    }
}
