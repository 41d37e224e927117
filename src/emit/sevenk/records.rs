//! Contents of the fields of 7k records.
//!
//! 7k axes are X starboard, Y forward, Z up; Echotank's body axes are x forward, y starboard, z down. Fields without a counterpart in the
//! model are 0. Source: DFD 3.12 (2020).

use std::fmt::Write;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use glam::DVec3;

use echotank_protocols::sevenk::control::PulseType;
use echotank_protocols::sevenk::records::{
    AttitudeSet, Depth1008, Heading1013, Installation7030, Module, MountingOffset, Navigation1015,
    Position1003, RemoteSettings7503, RollPitchHeave1012, Rth1009, SonarSettings7000,
    SoundVelocity7610, VelocityAtDepth, Version, emit_1009, emit_7001,
};
use echotank_protocols::sevenk::{ErrorCode, RecordStamp, SevenKTime, control_flags, device_id};

use super::stored_settings::StoredSettings;
use super::{RecordSet, UNCOMMON_RECORDS};
use echotank_config::spec::{NavSpec, SevenKSpec, SonarSpec};
use echotank_core::arrays::{Mounting, Pattern, TimeVaryingGain};
use echotank_core::navigation::{FixQuality, NavState};
use echotank_core::ping::{BeamFrame, PingPlan};
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::records::Datagram;
use echotank_core::settings::{SettingsPort, SonarSettings};
use echotank_core::sound_speed::SoundSpeedProfile;
use echotank_core::time::UtcNs;

/// Argument u at which sinc(pi u) is -3 dB (1/sqrt 2). Half the beam width of a line source is asin(HALF_POWER lambda / length).
/// For small angles, the full width is the usual 0.886 lambda / length.
const HALF_POWER: f64 = 0.442_946_47;

/// Depth of the second sample of the sound velocity profile, metres. It is below all oceans.
const DEEPEST_M: f32 = 12_000.0;

/// Accepted device identifiers besides the sonar's own: 0 (unspecified), the 7k Center, and two that the client of MBARI sends to
/// any sonar.
const ACCEPTED_DEVICES: [u32; 4] = [
    0,
    device_id::SONAR_SOURCE,
    device_id::SEABAT_7125,
    device_id::SEABAT_T50,
];

/// Properties of one sonar for 7k clients. They are constant during a run and shared by the emitter and the sessions.
#[derive(Clone, Debug)]
pub struct DeviceSheet {
    output: SevenKSpec,
    sonar: SonarSpec,
    sound_speed_m_per_s: f64,
    absorption_db_per_m: f64,
    /// Depth of the reference point without heave, metres.
    still_depth_m: f64,
    has_depth: bool,
    info_xml: String,
    /// Sound speed over depth in the newest ping, shared with the clones of this sheet; `None` where it is the same at all depths.
    profile: Arc<Mutex<Option<Arc<SoundSpeedProfile>>>>,
}

/// Values of the settings records that change from ping to ping.
#[derive(Clone, Copy, Debug)]
pub struct View {
    /// Current settings.
    pub settings: SonarSettings,
    /// Transmitted pulse.
    pub pulse: Pulse,
    /// Time between pings, seconds.
    pub ping_period_s: f64,
    /// Sound speed of the medium, metres per second.
    pub sound_speed_m_per_s: f64,
    /// One-way absorption of the medium, dB per metre.
    pub absorption_db_per_m: f64,
}

impl View {
    pub(crate) fn of_plan(plan: &PingPlan) -> Self {
        Self {
            settings: plan.settings,
            pulse: plan.pulse,
            ping_period_s: plan.ping_period_s,
            sound_speed_m_per_s: plan.sound_speed_m_per_s,
            absorption_db_per_m: plan.absorption_db_per_m,
        }
    }
    fn wavelength_m(&self) -> f64 {
        self.sound_speed_m_per_s / self.pulse.center_frequency_hz
    }
}

impl DeviceSheet {
    /// Addresses, besides its own, to which a client may direct records.
    pub(crate) fn third_parties(&self) -> &[IpAddr] {
        &self.output.third_parties
    }

    /// Sheet for one output and sonar. `sound_speed_m_per_s` and `absorption_db_per_m` (one way) apply to settings requested before
    /// the first ping.
    pub fn new(
        output: &SevenKSpec,
        sonar: &SonarSpec,
        sound_speed_m_per_s: f64,
        absorption_db_per_m: f64,
    ) -> Self {
        Self {
            output: output.clone(),
            info_xml: describe(output, sonar),
            sonar: sonar.clone(),
            sound_speed_m_per_s,
            absorption_db_per_m,
            still_depth_m: 0.0,
            has_depth: false,
            profile: Arc::default(),
        }
    }

    /// Sets the sound-speed profile before the first ping.
    #[must_use]
    pub fn with_profile(self, profile: Option<&Arc<SoundSpeedProfile>>) -> Self {
        *self.profile() = profile.cloned();
        self
    }

    /// Locks the profile. It is replaced in one assignment, so a poisoned lock holds a whole one.
    fn profile(&self) -> MutexGuard<'_, Option<Arc<SoundSpeedProfile>>> {
        self.profile.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes over the profile of a ping. Returns whether it is another than that of the ping before.
    pub(crate) fn renew_profile(&self, plan: &PingPlan) -> bool {
        let new = plan.refraction.as_ref().map(|water| &water.profile);
        let mut held = self.profile();
        let is_same = match (&*held, new) {
            (Some(held), Some(new)) => Arc::ptr_eq(held, new),
            (_, None) => true,
            (None, Some(_)) => false,
        };
        if !is_same {
            *held = new.cloned();
        }
        !is_same
    }

    /// Sets the depth of the platform's reference point from the navigation. Without this call the reference point is at the
    /// waterline.
    #[must_use]
    pub fn with_navigation(mut self, nav: &NavSpec) -> Self {
        self.still_depth_m = nav.still_depth_m().unwrap_or(0.0);
        self.has_depth = nav.has_depth();
        self
    }

    /// Record types that are written to files.
    pub fn file_records(&self) -> RecordSet {
        match self.output.has_common_files {
            true => RecordSet::ALL.without(RecordSet::of(&UNCOMMON_RECORDS)),
            false => RecordSet::ALL,
        }
    }

    /// Name of the sonar.
    pub fn name(&self) -> &str {
        &self.sonar.name
    }
    /// Configuration of the sonar.
    pub fn sonar(&self) -> &SonarSpec {
        &self.sonar
    }
    /// True if the fan detects the bottom.
    pub(crate) fn detects_bottom(&self) -> bool {
        let fan = self.sonar.beams.fan.as_ref();
        fan.is_some_and(|fan| fan.form.bottom_detection)
    }
    /// Serial number of the sonar.
    pub fn sonar_id(&self) -> u64 {
        self.sonar.serial
    }
    /// Sample rate of the receiver, hertz.
    pub fn sample_rate_hz(&self) -> f64 {
        self.sonar.receiver.sample_rate_hz
    }
    /// Full scale of the receiver, volts (rms).
    pub fn full_scale_v(&self) -> f64 {
        self.sonar.receiver.full_scale_v
    }
    /// Indices of the receive arrays of 7038, in this order.
    pub(crate) fn wire_arrays(&self) -> &[usize] {
        &self.output.arrays
    }
    /// Number of elements in 7038.
    pub(crate) fn wire_elements(&self) -> usize {
        self.output
            .arrays
            .iter()
            .map(|&a| self.sonar.receive[a].elements)
            .sum()
    }
    /// Number of elements of all receive arrays.
    pub(crate) fn receive_elements(&self) -> usize {
        self.sonar.receive.iter().map(|array| array.elements).sum()
    }

    /// Records that this sonar sends while it pings.
    pub(crate) fn ping_records(&self) -> RecordSet {
        let mut set = RecordSet::of(&[7000, 7503, 7610, 1003, 1012, 1013, 1015, 1016]);
        if self.has_depth {
            set.insert(1008);
        }
        if self.sonar.beams.fan.is_some() {
            set = set.union(RecordSet::of(&[7004, 7018, 7042]));
        }
        if self.detects_bottom() {
            set = set.union(RecordSet::of(&[7027, 7028, 7058]));
        }
        if !self.sonar.beams.lines.is_empty() {
            set = set.union(RecordSet::of(&[7007, 7057]));
        }
        if !self.output.arrays.is_empty() {
            set = set.union(RecordSet::of(&[7038, 10_038]));
        }
        set
    }

    /// True if a command to this device addresses this sonar. Enumerator 0 addresses all heads. Commands to the Center or to device
    /// 0 have no enumerator.
    pub fn accepts(&self, device: u32, enumerator: u16) -> bool {
        let ours = device == self.output.device_id;
        let known = ours || ACCEPTED_DEVICES.contains(&device);
        let head = enumerator == 0
            || enumerator == self.output.enumerator
            || device == 0
            || device == device_id::SONAR_SOURCE;
        known && head
    }

    // ------------------------------------------------------------ what the configuration fixes

    /// Returns an error unless the configured pulse has this type. Clients cannot change the type.
    pub(crate) fn confirms_pulse(&self, kind: PulseType) -> Result<(), ErrorCode> {
        let is_cw = self.sonar.pulse.kind == PulseKind::Cw;
        (is_cw == (kind == PulseType::ContinuousWave))
            .then_some(())
            .ok_or(ErrorCode::FeatureNotAvailable)
    }

    /// Returns an error unless the pulse has this centre frequency and bandwidth, to the precision of an f32. A bandwidth of 0 is
    /// not compared.
    pub(crate) fn confirms_band(&self, center_hz: f32, width_hz: f32) -> Result<(), ErrorCode> {
        let pulse = &self.sonar.pulse;
        let alike =
            |told: f32, is: f64| (f64::from(told) - is).abs() <= 1e-6 * pulse.center_frequency_hz;
        let fits = alike(center_hz, pulse.center_frequency_hz)
            && (width_hz == 0.0 || alike(width_hz.abs(), pulse.bandwidth_hz));
        fits.then_some(()).ok_or(ErrorCode::FeatureNotAvailable)
    }

    // ------------------------------------------------------------ stamps

    /// Timestamp of a record. 7k cannot represent times before 1970, so these become 1970.
    pub fn stamp(&self, utc: UtcNs) -> RecordStamp {
        RecordStamp {
            time: SevenKTime::from_utc_ns_clamped(utc.0),
            device_id: self.output.device_id,
            system_enumerator: self.output.enumerator,
        }
    }
    /// Timestamp of ping records: the end of the transmission.
    pub(crate) fn ping_stamp(&self, plan: &PingPlan) -> RecordStamp {
        self.stamp(plan.stamp_utc.plus_s(plan.pulse.duration_s))
    }
    /// Timestamp of navigation records: the time of the state, on the time axis of the ping's timestamp.
    pub(crate) fn nav_stamp(&self, plan: &PingPlan) -> RecordStamp {
        let after_transmit_ns = plan.nav.utc.0.saturating_sub(plan.transmit_utc.0);
        self.stamp(plan.stamp_utc.plus_ns(after_transmit_ns))
    }

    // ------------------------------------------------------------ settings

    /// Record 7000 (sonar settings) of one ping.
    pub(crate) fn settings_7000(
        &self,
        ping_number: u32,
        view: &View,
        receive_beam_width_rad: f64,
    ) -> SonarSettings7000 {
        let s = self.settings_7503(ping_number, view);
        SonarSettings7000 {
            sonar_id: s.sonar_id,
            ping_number: s.ping_number,
            frequency_hz: s.frequency_hz,
            sample_rate_hz: s.sample_rate_hz,
            receiver_bandwidth_hz: s.receiver_bandwidth_hz,
            tx_pulse_width_s: s.tx_pulse_width_s,
            tx_pulse_type: s.tx_pulse_type,
            tx_pulse_envelope: s.tx_pulse_envelope,
            tx_pulse_envelope_parameter: s.tx_pulse_envelope_parameter,
            tx_pulse_mode: s.tx_pulse_mode,
            max_ping_rate_hz: s.max_ping_rate_hz,
            ping_period_s: s.ping_period_s,
            range_m: s.range_m,
            power_db: s.power_db,
            gain_db: s.gain_db,
            control_flags: s.control_flags,
            projector_beam_width_vertical_rad: s.projector_beam_width_vertical_rad,
            projector_beam_width_horizontal_rad: s.projector_beam_width_horizontal_rad,
            receive_flags: s.receive_flags,
            receive_beam_width_rad: receive_beam_width_rad as f32,
            absorption_db_per_km: s.absorption_db_per_km,
            sound_velocity_m_per_s: s.sound_velocity_m_per_s,
            spreading_db: s.spreading_db,
            ..SonarSettings7000::default()
        }
    }

    /// Record 7503 (remote control settings) of one ping. Ping number 0 means the current settings.
    pub(crate) fn settings_7503(&self, ping_number: u32, view: &View) -> RemoteSettings7503 {
        let (along_rad, across_rad) = self.transmit_widths_rad(view);
        let mounting = self.sonar.transmit.first().map(|t| t.mounting);
        let offset = mounting.map_or(DVec3::ZERO, |m| m.position_m);
        let (roll_rad, pitch_rad) =
            tilts_rad(mounting.map_or(DVec3::Z, |m| m.body_from_array * DVec3::Z));
        RemoteSettings7503 {
            sonar_id: self.sonar.serial,
            ping_number,
            frequency_hz: view.pulse.center_frequency_hz as f32,
            sample_rate_hz: self.sample_rate_hz() as f32,
            // The bandwidth of complex samples is equal to their rate.
            receiver_bandwidth_hz: self.sample_rate_hz() as f32,
            tx_pulse_width_s: view.pulse.duration_s as f32,
            tx_pulse_type: match view.pulse.kind {
                PulseKind::Cw => 0,
                PulseKind::LfmUp | PulseKind::LfmDown => 1,
            },
            tx_pulse_envelope: if view.pulse.taper == 0.0 { 4 } else { 1 },
            tx_pulse_envelope_parameter: view.pulse.taper as f32,
            tx_pulse_mode: 1,
            max_ping_rate_hz: view.settings.max_ping_rate_hz as f32,
            ping_period_s: view.ping_period_s as f32,
            range_m: view.settings.range_m as f32,
            power_db: view.settings.source_level_db as f32,
            gain_db: view.settings.gain_db as f32,
            control_flags: control_flags::SIMULATOR
                | control_flags::SYSTEM_ACTIVE
                | control_flags::TIMESTAMP_STATE_OK,
            projector_beam_width_vertical_rad: along_rad as f32,
            projector_beam_width_horizontal_rad: across_rad as f32,
            receive_flags: self.receive_flags(),
            absorption_db_per_km: (view.absorption_db_per_m * 1000.0) as f32,
            sound_velocity_m_per_s: view.sound_speed_m_per_s as f32,
            spreading_db: self.spreading_db() as f32,
            tx_array_offset_x_m: offset.y as f32,
            tx_array_offset_y_m: offset.x as f32,
            tx_array_offset_z_m: -offset.z as f32,
            // Rotations are right-handed about X starboard (bow up) and Y forward (starboard down).
            head_tilt_x_rad: pitch_rad as f32,
            head_tilt_y_rad: roll_rad as f32,
            ping_state: if view.settings.pinging {
                RemoteSettings7503::PING_ENABLED
            } else {
                RemoteSettings7503::PING_DISABLED
            },
            beam_spacing_mode: u16::from(self.sonar.beams.fan.is_some()),
            coverage_angle_rad: self
                .sonar
                .beams
                .fan
                .as_ref()
                .map_or(0.0, |fan| fan.sector_rad) as f32,
            applied_frequency_hz: view.pulse.center_frequency_hz as f32,
            ..RemoteSettings7503::default()
        }
    }

    /// Answer to a request for a single 7503: the settings of the next ping, with ping number 0.
    pub(crate) fn current_settings_7503(&self, port: &dyn SettingsPort, now: UtcNs) -> Datagram {
        let settings = port.settings();
        let view = View {
            settings,
            pulse: Pulse {
                duration_s: settings.pulse_duration_s,
                ..self.sonar.pulse
            },
            ping_period_s: 0.0,
            sound_speed_m_per_s: self.sound_speed_m_per_s,
            absorption_db_per_m: self.absorption_db_per_m,
        };
        let mut bytes = Vec::new();
        let mut record = self.settings_7503(0, &view);
        StoredSettings::of(port).report_7503(&mut record);
        record.emit(&mut bytes, &self.stamp(now));
        Datagram {
            record_type: 7503,
            bytes,
        }
    }

    /// Record 7001 (configuration) with an XML description of the sonar.
    pub fn configuration_7001(&self, now: UtcNs) -> Datagram {
        let module = Module {
            identifier: self.output.device_id,
            // Readers take the serial number from the description. Devices write it as "SN" and digits.
            description: format!("SN{} {}", self.sonar.serial, self.sonar.name),
            alphadata_card: 0,
            serial_number: self.sonar.serial,
            info_xml: self.info_xml.clone(),
        };
        let mut bytes = Vec::new();
        emit_7001(&mut bytes, &self.stamp(now), self.sonar.serial, &[module]);
        Datagram {
            record_type: 7001,
            bytes,
        }
    }

    /// Records 7030 and 1009, which describe the rig and its water before the first ping.
    pub fn descriptions(&self, now: UtcNs) -> [Datagram; 2] {
        [self.installation_7030(now), self.profile_1009(now)]
    }

    /// Record 7030 (sonar installation parameters): the first transmit and the first receive array. Positions and motion are those
    /// of the reference point, so the sensors have no offsets.
    fn installation_7030(&self, now: UtcNs) -> Datagram {
        let mut bytes = Vec::new();
        let transmit = self.sonar.transmit.first();
        let receive = self.sonar.receive.first();
        let offset =
            |mounting: Option<&Mounting>| mounting.map(mounting_offset).unwrap_or_default();
        let version = Version::new(concat!("echotank ", env!("CARGO_PKG_VERSION")));
        let record = Installation7030 {
            frequency_hz: self.sonar.pulse.center_frequency_hz as f32,
            firmware: version,
            software: version,
            sevenk_software: version,
            record_protocol: Version::new("DFD 3.12"),
            transmit: offset(transmit.map(|t| &t.mounting)),
            receive: offset(receive.map(|r| &r.mounting)),
            waterline_m: self.still_depth_m as f32,
            ..Installation7030::default()
        };
        record.emit(&mut bytes, &self.stamp(now));
        Datagram {
            record_type: 7030,
            bytes,
        }
    }

    /// Record 1009 (sound velocity profile): the sound velocity of the water over depth.
    pub(crate) fn profile_1009(&self, now: UtcNs) -> Datagram {
        let mut bytes = Vec::new();
        let sample = |depth_m: f32, speed: f64| VelocityAtDepth {
            depth_m,
            sound_velocity_m_per_s: speed as f32,
        };
        let samples: Vec<_> = match &*self.profile() {
            Some(profile) => {
                let points = profile.points().iter();
                points
                    .map(|&(depth_m, c)| sample(depth_m as f32, c))
                    .collect()
            }
            None => [0.0, DEEPEST_M]
                .map(|depth_m| sample(depth_m, self.sound_speed_m_per_s))
                .into(),
        };
        emit_1009(&mut bytes, &self.stamp(now), &Rth1009::default(), &samples);
        Datagram {
            record_type: 1009,
            bytes,
        }
    }

    /// Bits 12 to 15: fans and lines are matched filtered. Bits 16 to 19: time-varying gain.
    fn receive_flags(&self) -> u32 {
        let beams = &self.sonar.beams;
        let is_filtered = beams.fan.is_some() || !beams.lines.is_empty();
        let has_tvg = self.sonar.receiver.tvg != TimeVaryingGain::None;
        (u32::from(is_filtered) << 12) | (u32::from(has_tvg) << 16)
    }

    /// Coefficient of log10(r) in the time-varying gain; 0 without time-varying gain.
    fn spreading_db(&self) -> f64 {
        match self.sonar.receiver.tvg {
            TimeVaryingGain::Law { spreading, .. } => spreading,
            TimeVaryingGain::None | TimeVaryingGain::Table(_) => 0.0,
        }
    }

    // ------------------------------------------------------------ beams

    /// -3 dB beam widths of the first transmit array, along and across track, radians.
    fn transmit_widths_rad(&self, view: &View) -> (f64, f64) {
        let Some(transmit) = self.sonar.transmit.first() else {
            return (std::f64::consts::TAU, std::f64::consts::TAU);
        };
        let (x_rad, y_rad) = match transmit.pattern {
            Pattern::Omnidirectional => (std::f64::consts::TAU, std::f64::consts::TAU),
            Pattern::Rectangle {
                length_m,
                width_m,
                baffled,
            }
            | Pattern::Part {
                length_m,
                width_m,
                baffled,
                ..
            } => {
                let wavelength_m = view.wavelength_m();
                (
                    line_width_rad(length_m, wavelength_m, baffled),
                    line_width_rad(width_m, wavelength_m, baffled),
                )
            }
        };
        // The array axis that is closer to the bow is the along-track axis.
        let rotation = transmit.mounting.body_from_array;
        let (x, y) = (rotation * DVec3::X, rotation * DVec3::Y);
        if x.x.abs() >= y.x.abs() {
            (x_rad, y_rad)
        } else {
            (y_rad, x_rad)
        }
    }

    pub(crate) fn along_track_width_rad(&self, view: &View) -> f64 {
        self.transmit_widths_rad(view).0
    }

    /// -3 dB width of the receive beam, radians. For a fan, the across-track width of the middle beam; otherwise, the width of the
    /// array of the first line.
    pub fn receive_beam_width_rad(&self, plan: &PingPlan, fan: Option<&BeamFrame>) -> f64 {
        if let Some(width_rad) = fan.and_then(|fan| fan.width_rad.get(fan.beams / 2)) {
            return *width_rad;
        }
        let array = self.sonar.beams.lines.first().map_or(0, |line| line.array);
        self.sonar.receive.get(array).map_or(0.0, |array| {
            let length_m = array.length_m();
            line_width_rad(length_m, View::of_plan(plan).wavelength_m(), true)
        })
    }
}

/// -3 dB beam width of a uniform line source, radians. A length of 0 or below the validity of the formula gives the full or half
/// circle, depending on the baffle.
fn line_width_rad(length_m: f64, wavelength_m: f64, baffled: bool) -> f64 {
    let sine = HALF_POWER * wavelength_m / length_m;
    if length_m > 0.0 && sine < 1.0 {
        2.0 * sine.asin()
    } else if baffled {
        std::f64::consts::PI
    } else {
        std::f64::consts::TAU
    }
}

// ---------------------------------------------------------------- navigation

/// Record 1003 (position) of the platform's reference point.
pub(crate) fn position_1003(nav: &NavState) -> Position1003 {
    Position1003 {
        datum_id: 0,
        latency_s: 0.0,
        latitude_rad_or_northing_m: nav.latitude_rad,
        longitude_rad_or_easting_m: nav.longitude_rad,
        height_m: nav.height_m,
        position_type: Position1003::GEOGRAPHIC,
        utm_zone: 0,
        // 1 means dead reckoning, the only quality flag of 7k navigation records.
        quality_flag: u8::from(nav.invalid.position || nav.fix == FixQuality::DeadReckoning),
        positioning_method: match nav.fix {
            FixQuality::None | FixQuality::Autonomous | FixQuality::DeadReckoning => 0,
            FixQuality::Differential => 1,
            FixQuality::RtkFixed => 15,
            FixQuality::RtkFloat => 16,
        },
        satellites: 0,
    }
}

/// Record 1008 (depth) of the reference point relative to the mean sea level.
pub(crate) fn depth_1008(still_depth_m: f64) -> Depth1008 {
    Depth1008 {
        descriptor: 0,
        correction: 1,
        depth_m: still_depth_m as f32,
    }
}

/// Offset of an array. The array axis closest to the bow gives the heading.
fn mounting_offset(mounting: &Mounting) -> MountingOffset {
    let rotation = mounting.body_from_array;
    let (roll_rad, pitch_rad) = tilts_rad(rotation * DVec3::Z);
    let axes = [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y].map(|axis| rotation * axis);
    let forward = axes.into_iter().max_by(|a, b| a.x.total_cmp(&b.x));
    let forward = forward.unwrap_or(DVec3::X);
    MountingOffset {
        x_m: mounting.position_m.y as f32,
        y_m: mounting.position_m.x as f32,
        z_m: -mounting.position_m.z as f32,
        roll_rad: roll_rad as f32,
        pitch_rad: pitch_rad as f32,
        heading_rad: forward.y.atan2(forward.x) as f32,
    }
}

/// Roll (port up) and pitch (bow up) of an array face with this boresight in the body.
fn tilts_rad(boresight: DVec3) -> (f64, f64) {
    let roll_rad = (-boresight.y).atan2(boresight.z);
    (roll_rad, boresight.x.clamp(-1.0, 1.0).asin())
}

/// Record 1012 (roll, pitch, heave). Roll is positive port up and pitch bow up, as in Echotank. Heave is positive up.
pub(crate) fn roll_pitch_heave_1012(nav: &NavState) -> RollPitchHeave1012 {
    RollPitchHeave1012 {
        roll_rad: nav.roll_rad as f32,
        pitch_rad: nav.pitch_rad as f32,
        heave_up_m: -nav.heave_down_m as f32,
    }
}

/// Record 1013 (heading).
pub(crate) fn heading_1013(nav: &NavState) -> Heading1013 {
    Heading1013 {
        heading_rad: nav.heading_rad as f32,
    }
}

/// Record 1015 (navigation). Accuracies are 0 (unknown). Heights are above the geoid, as in 1003.
pub(crate) fn navigation_1015(nav: &NavState) -> Navigation1015 {
    let velocity = nav.pose.velocity_m_per_s;
    Navigation1015 {
        vertical_reference: 2,
        latitude_rad: nav.latitude_rad,
        longitude_rad: nav.longitude_rad,
        horizontal_accuracy_m: 0.0,
        height_m: nav.height_m as f32,
        height_accuracy_m: 0.0,
        speed_over_ground_m_per_s: velocity.truncate().length() as f32,
        course_over_ground_rad: velocity
            .y
            .atan2(velocity.x)
            .rem_euclid(std::f64::consts::TAU) as f32,
        heading_rad: nav.heading_rad as f32,
    }
}

/// Record 1016 (attitude) with one measurement at the time of the record.
pub(crate) fn attitude_1016(nav: &NavState) -> AttitudeSet {
    AttitudeSet {
        after_ms: 0,
        roll_rad: nav.roll_rad as f32,
        pitch_rad: nav.pitch_rad as f32,
        heave_up_m: -nav.heave_down_m as f32,
        heading_rad: nav.heading_rad as f32,
    }
}

/// Record 7610 (sound velocity). Temperature and pressure are 0 (unknown).
pub(crate) fn sound_velocity_7610(sound_speed_m_per_s: f64) -> SoundVelocity7610 {
    SoundVelocity7610 {
        sound_velocity_m_per_s: sound_speed_m_per_s as f32,
        ..SoundVelocity7610::default()
    }
}

// ---------------------------------------------------------------- 7001

/// XML description of the sonar in SI units and body axes: x forward, y starboard, z down.
fn describe(output: &SevenKSpec, sonar: &SonarSpec) -> String {
    let mut xml = String::from("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n");
    let pulse = &sonar.pulse;
    let mut line = |text: std::fmt::Arguments<'_>| {
        xml.write_fmt(text)
            .expect("writing to a String cannot fail");
        xml.push('\n');
    };
    line(format_args!(
        "<sonar name=\"{}\" serial=\"{}\" device=\"{}\" enumerator=\"{}\" simulator=\"true\" software=\"echotank {}\">",
        escaped(&sonar.name),
        sonar.serial,
        output.device_id,
        output.enumerator,
        env!("CARGO_PKG_VERSION")
    ));
    line(format_args!(
        "  <pulse kind=\"{:?}\" center_frequency_hz=\"{}\" bandwidth_hz=\"{}\" taper=\"{}\"/>",
        pulse.kind, pulse.center_frequency_hz, pulse.bandwidth_hz, pulse.taper
    ));
    line(format_args!(
        "  <receiver sample_rate_hz=\"{}\" full_scale_v=\"{}\"/>",
        sonar.receiver.sample_rate_hz, sonar.receiver.full_scale_v
    ));
    for (name, array) in sonar.transmit_names.iter().zip(&sonar.transmit) {
        line(format_args!(
            "  <transmit name=\"{}\" {}/>",
            escaped(name),
            placed(&array.mounting)
        ));
    }
    for (index, (name, array)) in sonar.receive_names.iter().zip(&sonar.receive).enumerate() {
        let first = output
            .arrays
            .iter()
            .position(|&a| a == index)
            .map(|at| -> usize {
                output.arrays[..at]
                    .iter()
                    .map(|&a| sonar.receive[a].elements)
                    .sum()
            });
        let radius = array.radius_m.map_or(String::new(), |radius_m| {
            format!(" radius_m=\"{radius_m}\"")
        });
        let column = first.map_or(String::new(), |n| format!(" first_element_7038=\"{n}\""));
        line(format_args!(
            "  <receive name=\"{}\" elements=\"{}\" spacing_m=\"{}\"{radius} sensitivity_db=\"{}\"{column} {}/>",
            escaped(name),
            array.elements,
            array.spacing_m,
            array.sensitivity_db,
            placed(&array.mounting)
        ));
    }
    if let Some(fan) = &sonar.beams.fan {
        line(format_args!(
            "  <fan beams=\"{}\" sector_rad=\"{}\"/>",
            fan.beams, fan.sector_rad
        ));
    }
    line(format_args!("</sonar>"));
    xml
}

fn placed(mounting: &echotank_core::arrays::Mounting) -> String {
    let (roll, pitch, yaw) = echotank_core::frames::angles_from_rotation(mounting.body_from_array);
    let p = mounting.position_m;
    format!(
        "x_m=\"{}\" y_m=\"{}\" z_m=\"{}\" roll_rad=\"{roll}\" pitch_rad=\"{pitch}\" yaw_rad=\"{yaw}\"",
        p.x, p.y, p.z
    )
}

/// Escapes text for an attribute. XML cannot contain control characters, so these become blanks.
fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out
}
