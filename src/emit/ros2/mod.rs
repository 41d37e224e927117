//! ROS 2 messages of a ping in CDR, for MCAP files.
//!
//! | topic | message | content |
//! |---|---|---|
//! | `/echotank/SONAR/ARRAY/elements` | `RawSonarImage` | element samples of a receive array |
//! | `/echotank/SONAR/ARRAY/beams` | `RawSonarImage` | complex beams of the fan |
//! | `/echotank/SONAR/ARRAY/image` | `ProjectedSonarImage` | their magnitudes |
//! | `/echotank/SONAR/ARRAY/soundings` | `SonarDetections` | bottom detections, an entry for each beam |
//! | `/echotank/SONAR/SIDE/line` | `RawSonarImage` | side-scan line |
//! | `/echotank/SONAR/fix`, `/echotank/SONAR/pose` | `NavSatFix`, `PoseStamped` | reference point at the start of the pulse |
//! | `/tf`, `/tf_static` | `TFMessage` | `map` to `base_link`; `base_link` to the receive arrays |
//!
//! Images are 32-bit floats in volts (rms), a row for each sample. `marine_acoustic_msgs` has no complex type: I and Q of an element or beam are two
//! successive columns, so that `beam_count` is twice their number and the data of an image is an array of complex64.
//!
//! Frames follow REP 103 and REP 105: `map` is east, north, up from the rig's origin, and `base_link` is forward, left, up. The frame of a receive
//! array is `SONAR/ARRAY`; as `ProjectedSonarImage` defines, z is its boresight and y points along its line, to starboard or on a fore-and-aft array
//! forward. Hyphens of names become underscores, because ROS forbids them.
//!
//! Times are `stamp_utc` of the ping. Further pulses of a ping are left out.

mod definitions;

use std::f64::consts::FRAC_1_SQRT_2;

use byteorder::LittleEndian;
use glam::{DMat3, DQuat, DVec3};
use serde::{Serialize, Serializer};

use echotank_config::spec::{McapSpec, SonarSpec};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::navigation::FixQuality;
use echotank_core::ping::{BeamFrame, PingOutput, PingPlan, Side};
use echotank_core::time::{NS_PER_S, UtcNs};

/// CDR, version 1, little endian, without options.
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];
/// `SonarImageData.DTYPE_FLOAT32`.
const FLOAT32: u32 = 8;
/// `DetectionFlag.DETECT_BAD_SONAR`.
const BAD_SONAR: u8 = 1;

/// One topic and the type of its messages.
#[derive(Clone, Debug)]
pub struct Topic {
    /// Name, with a leading slash.
    pub name: String,
    /// Type, as `package/msg/Name`.
    pub type_name: String,
    /// Definition of the type and of the types in it, in the encoding `ros2msg`.
    pub definition: String,
}

/// Content of a topic.
#[derive(Clone, Copy)]
enum Content {
    TfStatic,
    Tf,
    Fix,
    Pose,
    Elements(usize),
    Line(Side),
    Beams,
    Image,
    Soundings,
}

impl Content {
    fn type_name(self) -> (&'static str, &'static str) {
        match self {
            Self::TfStatic | Self::Tf => ("tf2_msgs", "TFMessage"),
            Self::Fix => ("sensor_msgs", "NavSatFix"),
            Self::Pose => ("geometry_msgs", "PoseStamped"),
            Self::Elements(_) | Self::Line(_) | Self::Beams => {
                ("marine_acoustic_msgs", "RawSonarImage")
            }
            Self::Image => ("marine_acoustic_msgs", "ProjectedSonarImage"),
            Self::Soundings => ("marine_acoustic_msgs", "SonarDetections"),
        }
    }
}

/// Converter of pings into messages. It owns its buffers and serves one thread.
pub struct Ros2Emitter {
    sonar: SonarSpec,
    /// Frames of the receive arrays.
    frames: Vec<String>,
    topics: Vec<Topic>,
    contents: Vec<Content>,
    message: Vec<u8>,
    data: Vec<u8>,
}

impl Ros2Emitter {
    /// Emitter of the chosen contents that a sonar has.
    pub fn new(output: &McapSpec, sonar: &SonarSpec) -> Self {
        let own = format!("/echotank/{}", ros_name(&sonar.name));
        let frame = |name: &String| format!("{}/{}", ros_name(&sonar.name), ros_name(name));
        let frames: Vec<String> = sonar.receive_names.iter().map(frame).collect();
        let mut all = vec![
            ("/tf_static".to_owned(), Content::TfStatic),
            ("/tf".to_owned(), Content::Tf),
            (format!("{own}/fix"), Content::Fix),
            (format!("{own}/pose"), Content::Pose),
        ];
        if output.elements {
            let arrays = frames.iter().enumerate();
            all.extend(arrays.map(|(array, frame)| {
                (
                    format!("/echotank/{frame}/elements"),
                    Content::Elements(array),
                )
            }));
        }
        if output.lines {
            all.extend(sonar.beams.lines.iter().map(|line| {
                let side = match line.side {
                    Side::Port => "port",
                    Side::Starboard => "starboard",
                };
                (format!("{own}/{side}/line"), Content::Line(line.side))
            }));
        }
        if let Some(fan) = &sonar.beams.fan {
            let is_sounded = output.soundings && fan.form.bottom_detection;
            for (is_chosen, name, content) in [
                (output.beams, "beams", Content::Beams),
                (output.image, "image", Content::Image),
                (is_sounded, "soundings", Content::Soundings),
            ] {
                if is_chosen {
                    all.push((format!("/echotank/{}/{name}", frames[fan.array]), content));
                }
            }
        }
        let (topics, contents) = all
            .into_iter()
            .map(|(name, content)| {
                let (package, of) = content.type_name();
                let topic = Topic {
                    name,
                    type_name: format!("{package}/msg/{of}"),
                    definition: definitions::definition(&format!("{package}/{of}")),
                };
                (topic, content)
            })
            .unzip();
        Self {
            sonar: sonar.clone(),
            frames,
            topics,
            contents,
            message: Vec::new(),
            data: Vec::new(),
        }
    }

    /// The topics, in the order of their indices.
    pub fn topics(&self) -> &[Topic] {
        &self.topics
    }

    /// Calls `write` with the index of the topic and the bytes of each message of a ping, until it fails. The static frames are among them if
    /// `is_first`.
    ///
    /// # Errors
    /// That of `write`.
    pub fn emit_ping<E>(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        is_first: bool,
        mut write: impl FnMut(usize, &[u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        for topic in 0..self.contents.len() {
            let content = self.contents[topic];
            if matches!(content, Content::TfStatic) && !is_first {
                continue;
            }
            self.message.clear();
            self.message.extend(ENCAPSULATION);
            if self.emit(content, plan, output) {
                write(topic, &self.message)?;
            }
        }
        Ok(())
    }

    /// Appends a message to the encapsulation. False if the ping has no such content.
    fn emit(&mut self, content: Content, plan: &PingPlan, output: &PingOutput) -> bool {
        let stamp = Time::of(plan.stamp_utc);
        let pose = plan.trajectory.pose_at(0.0);
        let position = enu(pose.position_m);
        let rotation = map_from_base(pose.world_from_body);
        let rate_hz = self.sonar.receiver.sample_rate_hz;
        let first = (plan.first_sample_s * rate_hz).round().max(0.0) as u32;
        match content {
            Content::TfStatic => {
                let arrays = self.frames.iter().zip(&self.sonar.receive);
                let transforms = arrays.map(|(frame, array)| TransformStamped {
                    header: Header {
                        stamp,
                        frame_id: "base_link",
                    },
                    child_frame_id: frame,
                    transform: base_from_array(array),
                });
                put(
                    &mut self.message,
                    &TfMessage {
                        transforms: transforms.collect(),
                    },
                )
            }
            Content::Tf => put(
                &mut self.message,
                &TfMessage {
                    transforms: vec![TransformStamped {
                        header: Header {
                            stamp,
                            frame_id: "map",
                        },
                        child_frame_id: "base_link",
                        transform: Transform {
                            translation: position,
                            rotation,
                        },
                    }],
                },
            ),
            Content::Fix => {
                let has_fix = plan.nav.fix != FixQuality::None && !plan.nav.invalid.position;
                put(
                    &mut self.message,
                    &NavSatFix {
                        header: Header {
                            stamp,
                            frame_id: "base_link",
                        },
                        status: NavSatStatus {
                            status: if has_fix { 0 } else { -1 },
                            service: 0,
                        },
                        latitude: plan.nav.latitude_rad.to_degrees(),
                        longitude: plan.nav.longitude_rad.to_degrees(),
                        // The rig's vertical origin is not the ellipsoid.
                        altitude: f64::NAN,
                        position_covariance: [0.0; 9],
                        position_covariance_type: 0,
                    },
                )
            }
            Content::Pose => put(
                &mut self.message,
                &PoseStamped {
                    header: Header {
                        stamp,
                        frame_id: "map",
                    },
                    pose: Pose {
                        position,
                        orientation: rotation,
                    },
                },
            ),
            Content::Elements(array) => {
                let found = output.elements.iter().find(|frame| frame.array == array);
                let Some(frame) = found.filter(|frame| frame.elements > 0) else {
                    return false;
                };
                let iq = |e: usize, k: usize| {
                    let value = frame.iq[e * frame.samples + k];
                    [value.re as f32, value.im as f32]
                };
                fill(&mut self.data, frame.elements, frame.samples, iq);
                let angles = vec![0.0; 2 * frame.elements];
                self.put_image(plan, array, first, frame.samples, angles, Vec::new())
            }
            Content::Line(side) => {
                let found = output.lines.iter().find(|line| line.side == side);
                let spec = self.sonar.beams.lines.iter().find(|line| line.side == side);
                let (Some(line), Some(spec)) = (found, spec) else {
                    return false;
                };
                let amplitude = &line.amplitude;
                fill(&mut self.data, 1, amplitude.len(), |_, k| [amplitude[k]]);
                self.put_image(plan, spec.array, 0, amplitude.len(), vec![0.0], Vec::new())
            }
            Content::Beams | Content::Image | Content::Soundings => {
                let (Some(fan), Some(spec)) = (output.beams.first(), &self.sonar.beams.fan) else {
                    return false;
                };
                let array = spec.array;
                match content {
                    Content::Beams => {
                        let iq = |b: usize, k: usize| {
                            let value = fan.iq[b * fan.samples + k];
                            [value.re, value.im]
                        };
                        fill(&mut self.data, fan.beams, fan.samples, iq);
                        let twice =
                            |values: &[f64]| values.iter().flat_map(|v| [*v as f32; 2]).collect();
                        let (angles, widths) = (twice(&fan.angle_rad), twice(&fan.width_rad));
                        self.put_image(plan, array, first, fan.samples, angles, widths)
                    }
                    Content::Image => self.put_projection(plan, array, fan),
                    _ => self.put_soundings(plan, array, fan, output),
                }
            }
        }
    }

    /// Appends the image whose data are in `self.data`, with a column for each of `angles`.
    fn put_image(
        &mut self,
        plan: &PingPlan,
        array: usize,
        first: u32,
        samples: usize,
        angles: Vec<f32>,
        widths: Vec<f32>,
    ) -> bool {
        let zeros = vec![0.0; angles.len()];
        let image = RawSonarImage {
            header: Header {
                stamp: Time::of(plan.stamp_utc),
                frame_id: &self.frames[array],
            },
            ping_info: PingInfo::of(plan, widths),
            sample_rate: self.sonar.receiver.sample_rate_hz as f32,
            samples_per_beam: samples as u32,
            sample0: first,
            tx_delays: &zeros,
            tx_angles: &zeros,
            rx_angles: &angles,
            image: SonarImageData::of(angles.len(), &self.data),
        };
        put(&mut self.message, &image)
    }

    fn put_projection(&mut self, plan: &PingPlan, array: usize, fan: &BeamFrame) -> bool {
        let magnitude = |b: usize, k: usize| [fan.iq[b * fan.samples + k].norm()];
        fill(&mut self.data, fan.beams, fan.samples, magnitude);
        let directions = fan.angle_rad.iter().map(|angle| Vector3 {
            x: 0.0,
            y: angle.sin(),
            z: angle.cos(),
        });
        let rate_hz = self.sonar.receiver.sample_rate_hz;
        let ranges = (0..fan.samples).map(|k| {
            let time_s = plan.first_sample_s + k as f64 / rate_hz;
            (0.5 * plan.sound_speed_m_per_s * time_s) as f32
        });
        let widths = fan.width_rad.iter().map(|width| *width as f32);
        let image = ProjectedSonarImage {
            header: Header {
                stamp: Time::of(plan.stamp_utc),
                frame_id: &self.frames[array],
            },
            ping_info: PingInfo::of(plan, widths.collect()),
            beam_directions: directions.collect(),
            ranges: ranges.collect(),
            image: SonarImageData::of(fan.beams, &self.data),
        };
        put(&mut self.message, &image)
    }

    fn put_soundings(
        &mut self,
        plan: &PingPlan,
        array: usize,
        fan: &BeamFrame,
        output: &PingOutput,
    ) -> bool {
        let found = |beam| output.soundings.iter().find(move |s| s.beam == beam);
        let column = |of: fn(&echotank_core::ping::Sounding) -> f64| -> Vec<f32> {
            let values = (0..fan.beams).map(|beam| found(beam).map_or(f64::NAN, of) as f32);
            values.collect()
        };
        let flags = (0..fan.beams).map(|beam| DetectionFlag {
            flag: if found(beam).is_some() { 0 } else { BAD_SONAR },
        });
        let widths = fan.width_rad.iter().map(|width| *width as f32);
        let zeros = vec![0.0; fan.beams];
        let detections = SonarDetections {
            header: Header {
                stamp: Time::of(plan.stamp_utc),
                frame_id: &self.frames[array],
            },
            ping_info: PingInfo::of(plan, widths.collect()),
            flags: flags.collect(),
            two_way_travel_times: column(|s| s.twtt_s),
            tx_delays: &zeros,
            intensities: column(|s| s.level_v),
            tx_angles: &zeros,
            rx_angles: fan.angle_rad.iter().map(|angle| *angle as f32).collect(),
        };
        put(&mut self.message, &detections)
    }
}

/// A name of the configuration as a part of a ROS name.
fn ros_name(name: &str) -> String {
    let name = name.replace('-', "_");
    match name.starts_with(|c: char| c.is_ascii_digit()) {
        true => format!("_{name}"),
        false => name,
    }
}

/// Appends a message in CDR. Only maps and sequences of unknown length are refused, which no message has.
fn put(into: &mut Vec<u8>, message: &impl Serialize) -> bool {
    let written = cdr_encoding::to_writer::<_, LittleEndian, _>(into, message);
    debug_assert!(written.is_ok(), "{written:?}");
    written.is_ok()
}

/// Fills `data` with the values of each column at each sample, sample by sample.
fn fill<const N: usize>(
    data: &mut Vec<u8>,
    columns: usize,
    samples: usize,
    value: impl Fn(usize, usize) -> [f32; N],
) {
    data.clear();
    data.reserve(4 * N * columns * samples);
    for k in 0..samples {
        for column in 0..columns {
            data.extend(value(column, k).map(f32::to_le_bytes).as_flattened());
        }
    }
}

/// East, north, up of north, east, down.
fn enu(ned: DVec3) -> Vector3 {
    Vector3 {
        x: ned.y,
        y: ned.x,
        z: -ned.z,
    }
}

/// Half a turn about x: forward, starboard, down to forward, left, up, and back.
const HALF_TURN_X: DQuat = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);

fn map_from_base(world_from_body: DQuat) -> Quaternion {
    // Half a turn about the bisector of north and east.
    let enu_from_ned = DQuat::from_xyzw(FRAC_1_SQRT_2, FRAC_1_SQRT_2, 0.0, 0.0);
    Quaternion::of(enu_from_ned * world_from_body * HALF_TURN_X)
}

/// From the frame of a receive array to `base_link`.
fn base_from_array(array: &ArrayGeometry) -> Transform {
    let mounting = &array.mounting;
    let along = mounting.body_from_array * DVec3::X;
    let y = if along.y < -1e-9 { -DVec3::X } else { DVec3::X };
    let array_from_frame = DMat3::from_cols(y.cross(DVec3::Z), y, DVec3::Z);
    let rotation = HALF_TURN_X * mounting.body_from_array * DQuat::from_mat3(&array_from_frame);
    let DVec3 { x, y, z } = HALF_TURN_X * mounting.position_m;
    Transform {
        translation: Vector3 { x, y, z },
        rotation: Quaternion::of(rotation),
    }
}

#[derive(Clone, Copy, Serialize)]
struct Time {
    sec: i32,
    nanosec: u32,
}

impl Time {
    fn of(utc: UtcNs) -> Self {
        Self {
            sec: utc.0.div_euclid(NS_PER_S) as i32,
            nanosec: utc.0.rem_euclid(NS_PER_S) as u32,
        }
    }
}

#[derive(Clone, Copy, Serialize)]
struct Header<'a> {
    stamp: Time,
    frame_id: &'a str,
}

#[derive(Clone, Copy, Serialize)]
struct Vector3 {
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Clone, Copy, Serialize)]
struct Quaternion {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

impl Quaternion {
    fn of(q: DQuat) -> Self {
        let [x, y, z, w] = q.normalize().to_array();
        Self { x, y, z, w }
    }
}

#[derive(Serialize)]
struct Pose {
    position: Vector3,
    orientation: Quaternion,
}

#[derive(Serialize)]
struct PoseStamped<'a> {
    header: Header<'a>,
    pose: Pose,
}

#[derive(Serialize)]
struct Transform {
    translation: Vector3,
    rotation: Quaternion,
}

#[derive(Serialize)]
struct TransformStamped<'a> {
    header: Header<'a>,
    child_frame_id: &'a str,
    transform: Transform,
}

#[derive(Serialize)]
struct TfMessage<'a> {
    transforms: Vec<TransformStamped<'a>>,
}

#[derive(Serialize)]
struct NavSatStatus {
    status: i8,
    service: u16,
}

#[derive(Serialize)]
struct NavSatFix<'a> {
    header: Header<'a>,
    status: NavSatStatus,
    latitude: f64,
    longitude: f64,
    altitude: f64,
    position_covariance: [f64; 9],
    position_covariance_type: u8,
}

#[derive(Serialize)]
struct PingInfo {
    frequency: f32,
    sound_speed: f32,
    tx_beamwidths: Vec<f32>,
    rx_beamwidths: Vec<f32>,
}

impl PingInfo {
    fn of(plan: &PingPlan, rx_beamwidths: Vec<f32>) -> Self {
        Self {
            frequency: plan.pulse.center_frequency_hz as f32,
            sound_speed: plan.sound_speed_m_per_s as f32,
            tx_beamwidths: Vec::new(),
            rx_beamwidths,
        }
    }
}

/// A sequence of bytes, which is written at once.
struct Bytes<'a>(&'a [u8]);

impl Serialize for Bytes<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(self.0)
    }
}

#[derive(Serialize)]
struct SonarImageData<'a> {
    is_bigendian: bool,
    dtype: u32,
    beam_count: u32,
    data: Bytes<'a>,
}

impl<'a> SonarImageData<'a> {
    fn of(columns: usize, data: &'a [u8]) -> Self {
        Self {
            is_bigendian: false,
            dtype: FLOAT32,
            beam_count: columns as u32,
            data: Bytes(data),
        }
    }
}

#[derive(Serialize)]
struct RawSonarImage<'a> {
    header: Header<'a>,
    ping_info: PingInfo,
    sample_rate: f32,
    samples_per_beam: u32,
    sample0: u32,
    tx_delays: &'a [f32],
    tx_angles: &'a [f32],
    rx_angles: &'a [f32],
    image: SonarImageData<'a>,
}

#[derive(Serialize)]
struct ProjectedSonarImage<'a> {
    header: Header<'a>,
    ping_info: PingInfo,
    beam_directions: Vec<Vector3>,
    ranges: Vec<f32>,
    image: SonarImageData<'a>,
}

#[derive(Serialize)]
struct DetectionFlag {
    flag: u8,
}

#[derive(Serialize)]
struct SonarDetections<'a> {
    header: Header<'a>,
    ping_info: PingInfo,
    flags: Vec<DetectionFlag>,
    two_way_travel_times: Vec<f32>,
    tx_delays: &'a [f32],
    intensities: Vec<f32>,
    tx_angles: &'a [f32],
    rx_angles: Vec<f32>,
}
