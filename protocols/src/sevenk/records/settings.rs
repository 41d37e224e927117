//! What the sonar is set to: 7000 with every ping, 7503 the same for remote control and more. Source: DFD 3.12.
//!
//! A 7503 with ping number 0 means "the settings now". Bit 31 of the control flags says that a simulator speaks
//! ([`control_flags`]); a program that makes its data up sets it.

use std::fmt;

use binrw::{BinRead, BinWrite};

use super::rth_record;
use crate::sevenk::{control_flags, record_id};

/// 7000: the settings of one ping. Sent first of the ping's records.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct SonarSettings7000 {
    /// Serial number.
    pub sonar_id: u64,
    /// Sequential from 1.
    pub ping_number: u32,
    /// 0 when not in multi-ping mode.
    pub multi_ping_sequence: u16,
    pub frequency_hz: f32,
    pub sample_rate_hz: f32,
    pub receiver_bandwidth_hz: f32,
    pub tx_pulse_width_s: f32,
    /// 0 continuous wave, 1 linear chirp.
    pub tx_pulse_type: u32,
    /// 0 tapered rectangle, 1 Tukey, 2 Hamming, 3 Hann, 4 rectangle.
    pub tx_pulse_envelope: u32,
    pub tx_pulse_envelope_parameter: f32,
    /// 1 single ping, 2..=4 multi-ping.
    #[brw(pad_after = 2)]
    pub tx_pulse_mode: u16,
    pub max_ping_rate_hz: f32,
    /// Since the last ping.
    pub ping_period_s: f32,
    pub range_m: f32,
    /// Source level, dB re 1 uPa at 1 m.
    pub power_db: f32,
    pub gain_db: f32,
    /// See [`control_flags`].
    pub control_flags: u32,
    pub projector_id: u32,
    pub projector_steer_vertical_rad: f32,
    pub projector_steer_horizontal_rad: f32,
    /// At -3 dB, along track.
    pub projector_beam_width_vertical_rad: f32,
    /// At -3 dB, across track.
    pub projector_beam_width_horizontal_rad: f32,
    pub projector_focal_point_m: f32,
    /// 0 rectangular, 1 Chebychev, 2 Gauss.
    pub projector_weighting_type: u32,
    pub projector_weighting_parameter: f32,
    /// Bits 0..=3 pitch stabilisation, 4..=7 yaw stabilisation.
    pub transmit_flags: u32,
    pub hydrophone_id: u32,
    /// 0 Chebychev, 1 Kaiser.
    pub receive_weighting_type: u32,
    pub receive_weighting_parameter: f32,
    /// Bit 0 roll compensation, bit 2 heave compensation, 4..=7 focusing, 12..=15 matched filter, 16..=19 TVG.
    pub receive_flags: u32,
    pub receive_beam_width_rad: f32,
    pub bottom_filter_min_range_m: f32,
    pub bottom_filter_max_range_m: f32,
    pub bottom_filter_min_depth_m: f32,
    pub bottom_filter_max_depth_m: f32,
    pub absorption_db_per_km: f32,
    pub sound_velocity_m_per_s: f32,
    #[brw(pad_after = 2)]
    pub spreading_db: f32,
}

/// 7503: the settings as remote control shows them.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct RemoteSettings7503 {
    /// Serial number.
    pub sonar_id: u64,
    /// 0 in the answer to a single-record request.
    pub ping_number: u32,
    pub frequency_hz: f32,
    pub sample_rate_hz: f32,
    pub receiver_bandwidth_hz: f32,
    pub tx_pulse_width_s: f32,
    /// 0 continuous wave, 1 linear chirp.
    pub tx_pulse_type: u32,
    /// 0 tapered rectangle, 1 Tukey, 2 Hamming, 3 Hann, 4 rectangle.
    pub tx_pulse_envelope: u32,
    pub tx_pulse_envelope_parameter: f32,
    /// 1 single ping, 2..=4 multi-ping.
    #[brw(pad_after = 2)]
    pub tx_pulse_mode: u16,
    pub max_ping_rate_hz: f32,
    /// Since the last ping.
    pub ping_period_s: f32,
    pub range_m: f32,
    /// Source level, dB re 1 uPa at 1 m.
    pub power_db: f32,
    pub gain_db: f32,
    /// See [`control_flags`].
    pub control_flags: u32,
    pub projector_id: u32,
    pub projector_steer_vertical_rad: f32,
    pub projector_steer_horizontal_rad: f32,
    /// At -3 dB, along track.
    pub projector_beam_width_vertical_rad: f32,
    /// At -3 dB, across track.
    pub projector_beam_width_horizontal_rad: f32,
    pub projector_focal_point_m: f32,
    /// 0 rectangular, 1 Chebychev, 2 Gauss.
    pub projector_weighting_type: u32,
    pub projector_weighting_parameter: f32,
    /// Bits 0..=3 pitch stabilisation, 4..=7 yaw stabilisation.
    pub transmit_flags: u32,
    pub hydrophone_id: u32,
    /// 0 Chebychev, 1 Kaiser.
    pub receive_weighting_type: u32,
    pub receive_weighting_parameter: f32,
    /// Bit 0 roll compensation, bit 2 heave compensation, 4..=7 focusing, 12..=15 matched filter, 16..=19 TVG.
    pub receive_flags: u32,
    pub bottom_filter_min_range_m: f32,
    pub bottom_filter_max_range_m: f32,
    pub bottom_filter_min_depth_m: f32,
    pub bottom_filter_max_depth_m: f32,
    pub absorption_db_per_km: f32,
    pub sound_velocity_m_per_s: f32,
    pub spreading_db: f32,
    pub vernier_operation_mode: u8,
    /// Percent of depth.
    pub automatic_filter_window_percent: u8,
    /// Right is positive.
    pub tx_array_offset_x_m: f32,
    /// Forward is positive.
    pub tx_array_offset_y_m: f32,
    /// Up is positive.
    pub tx_array_offset_z_m: f32,
    pub head_tilt_x_rad: f32,
    pub head_tilt_y_rad: f32,
    pub head_tilt_z_rad: f32,
    /// See [`RemoteSettings7503::PING_ENABLED`] and its neighbours.
    pub ping_state: u32,
    /// 1 equiangle, 2 equidistant, 3 flex, 4 intermediate.
    pub beam_spacing_mode: u16,
    /// 0 normal, 1 autopilot or tracker, 2 calibration (I/Q).
    pub sonar_mode: u16,
    pub adaptive_gate_min_depth_m: f32,
    pub adaptive_gate_max_depth_m: f32,
    pub trigger_out_width_s: f64,
    pub trigger_out_offset_s: f64,
    #[brw(pad_after = 8)]
    pub seabat_81xx_projector: u16,
    pub seabat_81xx_alternate_gain_db: f32,
    #[brw(pad_after = 1)]
    pub vernier_filter: u8,
    pub custom_beams: u16,
    pub coverage_angle_rad: f32,
    pub coverage_mode: u8,
    pub quality_filter_flags: u8,
    /// Starboard is positive.
    pub rx_horizontal_steering_rad: f32,
    pub flex_sector_coverage_rad: f32,
    pub flex_sector_steering_rad: f32,
    pub constant_spacing_m: f32,
    pub beam_mode_selection: u16,
    pub depth_gate_tilt_rad: f32,
    pub applied_frequency_hz: f32,
    /// Receive element shown in 7049.
    pub element_number: u32,
}

impl RemoteSettings7503 {
    pub const PING_DISABLED: u32 = 0;
    pub const PING_ENABLED: u32 = 1;
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
