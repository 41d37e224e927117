//! Records of the settings of the sonar: 7000 with every ping, 7503 with more fields for remote control. Source: DFD 3.12.
//!
//! A 7503 with ping number 0 has the current settings. Bit 31 of the control flags ([`control_flags`]) states that the data come
//! from a simulator.

use std::fmt;

use binrw::{BinRead, BinWrite};

use super::rth_record;
use crate::sevenk::{control_flags, record_id};

/// Record 7000 (sonar settings): settings of one ping, the first of the ping's records.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct SonarSettings7000 {
    /// Serial number of the sonar.
    pub sonar_id: u64,
    /// Ping number, sequential from 1.
    pub ping_number: u32,
    /// Sequence number in multi-ping mode; 0 in other modes.
    pub multi_ping_sequence: u16,
    /// Centre frequency.
    pub frequency_hz: f32,
    /// Sample rate.
    pub sample_rate_hz: f32,
    /// Bandwidth of the receiver.
    pub receiver_bandwidth_hz: f32,
    /// Pulse length.
    pub tx_pulse_width_s: f32,
    /// Pulse type: 0 continuous wave, 1 linear chirp.
    pub tx_pulse_type: u32,
    /// Pulse envelope: 0 tapered rectangle, 1 Tukey, 2 Hamming, 3 Hann, 4 rectangle.
    pub tx_pulse_envelope: u32,
    /// Parameter of the envelope.
    pub tx_pulse_envelope_parameter: f32,
    /// Ping mode: 1 single ping, 2..=4 multi-ping.
    #[brw(pad_after = 2)]
    pub tx_pulse_mode: u16,
    /// Maximum ping rate.
    pub max_ping_rate_hz: f32,
    /// Time since the last ping.
    pub ping_period_s: f32,
    /// Slant range.
    pub range_m: f32,
    /// Source level, dB re 1 uPa at 1 m.
    pub power_db: f32,
    /// Receiver gain.
    pub gain_db: f32,
    /// Bits of [`control_flags`].
    pub control_flags: u32,
    /// Number of the projector.
    pub projector_id: u32,
    /// Direction of the transmit beam along track.
    pub projector_steer_vertical_rad: f32,
    /// Direction of the transmit beam across track.
    pub projector_steer_horizontal_rad: f32,
    /// Along-track width of the transmit beam, -3 dB.
    pub projector_beam_width_vertical_rad: f32,
    /// Across-track width of the transmit beam, -3 dB.
    pub projector_beam_width_horizontal_rad: f32,
    /// Distance of the transmit focus; 0 is infinity.
    pub projector_focal_point_m: f32,
    /// Transmit weighting: 0 rectangular, 1 Chebyshev, 2 Gauss.
    pub projector_weighting_type: u32,
    /// Parameter of the transmit weighting.
    pub projector_weighting_parameter: f32,
    /// Bits 0 to 3 pitch stabilisation, 4 to 7 yaw stabilisation.
    pub transmit_flags: u32,
    /// Number of the receiver.
    pub hydrophone_id: u32,
    /// Receive weighting: 0 Chebyshev, 1 Kaiser.
    pub receive_weighting_type: u32,
    /// Parameter of the receive weighting.
    pub receive_weighting_parameter: f32,
    /// Bit 0 roll compensation, bit 2 heave compensation, 4 to 7 focusing, 12 to 15 matched filter, 16 to 19 TVG.
    pub receive_flags: u32,
    /// Width of the receive beam, -3 dB.
    pub receive_beam_width_rad: f32,
    /// Minimum range of the bottom detection.
    pub bottom_filter_min_range_m: f32,
    /// Maximum range of the bottom detection.
    pub bottom_filter_max_range_m: f32,
    /// Minimum depth of the bottom detection.
    pub bottom_filter_min_depth_m: f32,
    /// Maximum depth of the bottom detection.
    pub bottom_filter_max_depth_m: f32,
    /// Absorption of the time-varying gain, one way.
    pub absorption_db_per_km: f32,
    /// Sound velocity.
    pub sound_velocity_m_per_s: f32,
    /// Coefficient of log10(range) in the time-varying gain.
    #[brw(pad_after = 2)]
    pub spreading_db: f32,
}

/// Record 7503 (remote control settings): settings of one ping or current settings.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct RemoteSettings7503 {
    /// Serial number of the sonar.
    pub sonar_id: u64,
    /// Ping number; 0 in the answer to a single-record request.
    pub ping_number: u32,
    /// Centre frequency.
    pub frequency_hz: f32,
    /// Sample rate.
    pub sample_rate_hz: f32,
    /// Bandwidth of the receiver.
    pub receiver_bandwidth_hz: f32,
    /// Pulse length.
    pub tx_pulse_width_s: f32,
    /// Pulse type: 0 continuous wave, 1 linear chirp.
    pub tx_pulse_type: u32,
    /// Pulse envelope: 0 tapered rectangle, 1 Tukey, 2 Hamming, 3 Hann, 4 rectangle.
    pub tx_pulse_envelope: u32,
    /// Parameter of the envelope.
    pub tx_pulse_envelope_parameter: f32,
    /// Ping mode: 1 single ping, 2..=4 multi-ping.
    #[brw(pad_after = 2)]
    pub tx_pulse_mode: u16,
    /// Maximum ping rate.
    pub max_ping_rate_hz: f32,
    /// Time since the last ping.
    pub ping_period_s: f32,
    /// Slant range.
    pub range_m: f32,
    /// Source level, dB re 1 uPa at 1 m.
    pub power_db: f32,
    /// Receiver gain.
    pub gain_db: f32,
    /// Bits of [`control_flags`].
    pub control_flags: u32,
    /// Number of the projector.
    pub projector_id: u32,
    /// Direction of the transmit beam along track.
    pub projector_steer_vertical_rad: f32,
    /// Direction of the transmit beam across track.
    pub projector_steer_horizontal_rad: f32,
    /// Along-track width of the transmit beam, -3 dB.
    pub projector_beam_width_vertical_rad: f32,
    /// Across-track width of the transmit beam, -3 dB.
    pub projector_beam_width_horizontal_rad: f32,
    /// Distance of the transmit focus; 0 is infinity.
    pub projector_focal_point_m: f32,
    /// Transmit weighting: 0 rectangular, 1 Chebyshev, 2 Gauss.
    pub projector_weighting_type: u32,
    /// Parameter of the transmit weighting.
    pub projector_weighting_parameter: f32,
    /// Bits 0 to 3 pitch stabilisation, 4 to 7 yaw stabilisation.
    pub transmit_flags: u32,
    /// Number of the receiver.
    pub hydrophone_id: u32,
    /// Receive weighting: 0 Chebyshev, 1 Kaiser.
    pub receive_weighting_type: u32,
    /// Parameter of the receive weighting.
    pub receive_weighting_parameter: f32,
    /// Bit 0 roll compensation, bit 2 heave compensation, 4 to 7 focusing, 12 to 15 matched filter, 16 to 19 TVG.
    pub receive_flags: u32,
    /// Minimum range of the bottom detection.
    pub bottom_filter_min_range_m: f32,
    /// Maximum range of the bottom detection.
    pub bottom_filter_max_range_m: f32,
    /// Minimum depth of the bottom detection.
    pub bottom_filter_min_depth_m: f32,
    /// Maximum depth of the bottom detection.
    pub bottom_filter_max_depth_m: f32,
    /// Absorption of the time-varying gain, one way.
    pub absorption_db_per_km: f32,
    /// Sound velocity.
    pub sound_velocity_m_per_s: f32,
    /// Coefficient of log10(range) in the time-varying gain.
    pub spreading_db: f32,
    /// Mode of the vernier filter; not used.
    pub vernier_operation_mode: u8,
    /// Width of the automatic filter, percent of depth.
    pub automatic_filter_window_percent: u8,
    /// Offset of the transmit array, positive to starboard.
    pub tx_array_offset_x_m: f32,
    /// Offset of the transmit array, positive forward.
    pub tx_array_offset_y_m: f32,
    /// Offset of the transmit array, positive up.
    pub tx_array_offset_z_m: f32,
    /// Rotation about the starboard axis, positive bow up.
    pub head_tilt_x_rad: f32,
    /// Rotation about the forward axis, positive starboard down.
    pub head_tilt_y_rad: f32,
    /// Rotation about the upward axis.
    pub head_tilt_z_rad: f32,
    /// State of pinging: [`RemoteSettings7503::PING_ENABLED`] or one of the constants next to it.
    pub ping_state: u32,
    /// Beam spacing: 1 equiangle, 2 equidistant, 3 flex, 4 intermediate.
    pub beam_spacing_mode: u16,
    /// Sonar mode: 0 normal, 1 autopilot or tracker, 2 calibration (I/Q).
    pub sonar_mode: u16,
    /// Minimum depth of the adaptive gate.
    pub adaptive_gate_min_depth_m: f32,
    /// Maximum depth of the adaptive gate.
    pub adaptive_gate_max_depth_m: f32,
    /// Length of the trigger output.
    pub trigger_out_width_s: f64,
    /// Delay of the trigger output.
    pub trigger_out_offset_s: f64,
    /// Projector of a SeaBat 81xx.
    #[brw(pad_after = 8)]
    pub seabat_81xx_projector: u16,
    /// Alternate gain of a SeaBat 81xx.
    pub seabat_81xx_alternate_gain_db: f32,
    /// Vernier filter; not used.
    #[brw(pad_after = 1)]
    pub vernier_filter: u8,
    /// Number of beams if customised.
    pub custom_beams: u16,
    /// Width of the swath.
    pub coverage_angle_rad: f32,
    /// Rule for the swath width.
    pub coverage_mode: u8,
    /// Tests of the quality filter.
    pub quality_filter_flags: u8,
    /// Direction of the receive sector, positive to starboard.
    pub rx_horizontal_steering_rad: f32,
    /// Width of the flex sector.
    pub flex_sector_coverage_rad: f32,
    /// Direction of the flex sector, positive to starboard.
    pub flex_sector_steering_rad: f32,
    /// Spacing of the beams on the bottom.
    pub constant_spacing_m: f32,
    /// Number of the beam mode.
    pub beam_mode_selection: u16,
    /// Tilt of the depth gates.
    pub depth_gate_tilt_rad: f32,
    /// Frequency in use.
    pub applied_frequency_hz: f32,
    /// Receive element that 7049 contains.
    pub element_number: u32,
}

impl RemoteSettings7503 {
    /// No pinging.
    pub const PING_DISABLED: u32 = 0;
    /// The sonar's own clock starts pings.
    pub const PING_ENABLED: u32 = 1;
    /// An external trigger starts pings.
    pub const PING_EXTERNAL_TRIGGER: u32 = 2;
}

rth_record!(
    SonarSettings7000,
    record_id::SONAR_SETTINGS,
    156,
    "7000 sonar settings"
);
rth_record!(
    RemoteSettings7503,
    record_id::REMOTE_CONTROL_SETTINGS,
    260,
    "7503 remote control sonar settings"
);

fn source_of(flags: u32) -> &'static str {
    if flags & control_flags::SIMULATOR != 0 {
        "simulator"
    } else {
        "no simulator"
    }
}

impl fmt::Display for SonarSettings7000 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "sonar settings: ping {} of sonar {}, {:.1} Hz, fs {:.1} Hz, pulse {:.6} s type {}, range {:.2} m, power {:.1} dB, \
             gain {:.1} dB, period {:.4} s, sound {:.2} m/s, {}",
            self.ping_number,
            self.sonar_id,
            self.frequency_hz,
            self.sample_rate_hz,
            self.tx_pulse_width_s,
            self.tx_pulse_type,
            self.range_m,
            self.power_db,
            self.gain_db,
            self.ping_period_s,
            self.sound_velocity_m_per_s,
            source_of(self.control_flags)
        )
    }
}

impl fmt::Display for RemoteSettings7503 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "remote control settings: ping {} of sonar {}, {:.1} Hz, fs {:.1} Hz, pulse {:.6} s type {}, range {:.2} m, \
             power {:.1} dB, gain {:.1} dB, at most {:.2} pings/s, ping state {}, coverage {:.1} deg, {}",
            self.ping_number,
            self.sonar_id,
            self.frequency_hz,
            self.sample_rate_hz,
            self.tx_pulse_width_s,
            self.tx_pulse_type,
            self.range_m,
            self.power_db,
            self.gain_db,
            self.max_ping_rate_hz,
            self.ping_state,
            self.coverage_angle_rad.to_degrees(),
            source_of(self.control_flags)
        )
    }
}
