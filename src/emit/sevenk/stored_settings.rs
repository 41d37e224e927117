//! Settings of a SeaBat that the model does not use. They are stored and reported in 7503 as the client set them. Record 7000
//! describes the ping, so it reports only stored settings for which the model has no value.

use echotank_protocols::sevenk::Command;
use echotank_protocols::sevenk::control::{GainType, PulseEnvelope};
use echotank_protocols::sevenk::records::{RemoteSettings7503, SonarSettings7000};

use echotank_core::settings::{SettingsPort, StoredKey, StoredValue, TriggerSource};

/// Name under which 7k changes settings.
pub(crate) const VIA: &str = "7k";

/// Names of the stored settings.
mod name {
    pub(crate) const DETECTION_MASK: &str = "bottom detection mask";
    pub(crate) const DETECTION_FILTER: &str = "bottom detection filter";
    pub(super) const GAIN_TYPE: &str = "gain type";
    pub(super) const PULSE_ENVELOPE: &str = "pulse envelope";
    pub(super) const PROJECTOR_STEERING: &str = "projector steering";
    pub(crate) const PROJECTOR_WIDTHS: &str = "projector beam widths";
    pub(crate) const MOTION: &str = "motion compensation";
    pub(super) const MATCH_FILTER: &str = "match filter";
    pub(crate) const COVERAGE: &str = "coverage sector";
    pub(super) const TRIGGER_OUT: &str = "trigger out";
    pub(super) const PPS_EDGE: &str = "pps edge";
    pub(super) const SNIPPETS: &str = "snippet control";
    pub(super) const WATER_COLUMN: &str = "compressed water column";
    pub(super) const SOUND_VELOCITY: &str = "sound velocity";
}

/// Key of the stored setting `name`.
pub(crate) fn key(name: &'static str) -> StoredKey {
    StoredKey {
        via: VIA,
        name,
        place: 0,
    }
}

/// Name and values of the setting that a command stores; `None` for commands with an effect.
pub(crate) fn stored_setting(command: &Command) -> Option<(&'static str, Vec<f64>)> {
    Some(match *command {
        Command::BottomDetectionMask { flags } => (name::DETECTION_MASK, vec![flags.into()]),
        Command::BottomDetectionFilter {
            min_range_m,
            max_range_m,
            min_depth_m,
            max_depth_m,
            gate_tilt_rad,
        } => (
            name::DETECTION_FILTER,
            [
                min_range_m,
                max_range_m,
                min_depth_m,
                max_depth_m,
                gate_tilt_rad.unwrap_or(0.0),
            ]
            .map(f64::from)
            .to_vec(),
        ),
        Command::GainType(kind) => (
            name::GAIN_TYPE,
            vec![match kind {
                GainType::Tvg => 0.0,
                GainType::Fixed => 2.0,
            }],
        ),
        Command::PulseEnvelope { envelope, shading } => (
            name::PULSE_ENVELOPE,
            vec![
                match envelope {
                    // Values of the field in 7503.
                    PulseEnvelope::Rectangle => 4.0,
                    PulseEnvelope::Tukey => 1.0,
                },
                shading.into(),
            ],
        ),
        Command::ProjectorSteering {
            vertical_rad,
            horizontal_rad,
        } => (
            name::PROJECTOR_STEERING,
            vec![vertical_rad.into(), horizontal_rad.into()],
        ),
        Command::ProjectorBeamWidths {
            vertical_rad,
            horizontal_rad,
        } => (
            name::PROJECTOR_WIDTHS,
            vec![vertical_rad.into(), horizontal_rad.into()],
        ),
        Command::MotionCompensation { roll, pitch } => {
            (name::MOTION, vec![roll.into(), pitch.into()])
        }
        Command::MatchFilter { window, shading } => {
            (name::MATCH_FILTER, vec![window.into(), shading.into()])
        }
        Command::CoverageSector {
            sector_rad,
            rx_steering_rad,
        } => (
            name::COVERAGE,
            vec![sector_rad.into(), rx_steering_rad.into()],
        ),
        Command::TriggerOut {
            flags,
            length_s,
            offset_s,
        } => (name::TRIGGER_OUT, vec![flags.into(), length_s, offset_s]),
        Command::PpsEdge { edge } => (name::PPS_EDGE, vec![edge.into()]),
        Command::SnippetControl {
            flags,
            min_window_samples,
            max_window_samples,
        } => (
            name::SNIPPETS,
            vec![
                flags.into(),
                min_window_samples.into(),
                max_window_samples.into(),
            ],
        ),
        Command::CompressedWaterColumn { flags } => (name::WATER_COLUMN, vec![flags.into()]),
        Command::SoundVelocity {
            flags,
            sound_velocity_m_per_s,
            filter,
        } => (
            name::SOUND_VELOCITY,
            vec![flags.into(), sound_velocity_m_per_s.into(), filter.into()],
        ),
        _ => return None,
    })
}

/// Limits on the length of snippets (7028).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SnippetWindow {
    /// Flags of the snippet control command.
    pub flags: u32,
    /// Minimum length, samples.
    pub(crate) min_samples: u32,
    /// Maximum length, samples.
    pub max_samples: u32,
}

impl Default for SnippetWindow {
    /// Length from the footprint of the beam. The maximum keeps a record of a thousand beams below a megabyte.
    fn default() -> Self {
        Self {
            flags: 1,
            min_samples: 1,
            max_samples: 500,
        }
    }
}

/// Stored settings that the records contain.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StoredSettings {
    /// Limits on the length of snippets.
    pub snippets: SnippetWindow,
    /// Set-up flags of 7042.
    pub(crate) water_column_flags: u32,
    detection_filter: Option<[f64; 5]>,
    envelope: Option<[f64; 2]>,
    steering: Option<[f64; 2]>,
    widths: Option<[f64; 2]>,
    motion: Option<[f64; 2]>,
    coverage: Option<[f64; 2]>,
    trigger_out: Option<[f64; 3]>,
    sound_velocity: Option<[f64; 3]>,
    /// True if external triggers start the pings.
    pub(crate) foreign_trigger: bool,
}

impl StoredSettings {
    /// Reads the stored settings.
    pub fn of(settings: &dyn SettingsPort) -> Self {
        fn numbers<const N: usize>(
            settings: &dyn SettingsPort,
            name: &'static str,
        ) -> Option<[f64; N]> {
            match settings.stored(key(name)) {
                Some(StoredValue::Numbers(numbers)) => numbers.try_into().ok(),
                _ => None,
            }
        }
        let snippets = numbers::<3>(settings, name::SNIPPETS).map(|n| n.map(|v| v as u32));
        Self {
            snippets: snippets.map_or_else(
                SnippetWindow::default,
                |[flags, min_samples, max_samples]| SnippetWindow {
                    flags,
                    min_samples,
                    max_samples,
                },
            ),
            water_column_flags: numbers::<1>(settings, name::WATER_COLUMN)
                .map_or(0, |[flags]| flags as u32),
            detection_filter: numbers(settings, name::DETECTION_FILTER),
            envelope: numbers(settings, name::PULSE_ENVELOPE),
            steering: numbers(settings, name::PROJECTOR_STEERING),
            widths: numbers(settings, name::PROJECTOR_WIDTHS),
            motion: numbers(settings, name::MOTION),
            coverage: numbers(settings, name::COVERAGE),
            trigger_out: numbers(settings, name::TRIGGER_OUT),
            sound_velocity: numbers(settings, name::SOUND_VELOCITY),
            foreign_trigger: settings.trigger() == TriggerSource::External,
        }
    }

    /// Overrides fields of 7503 with stored settings.
    pub(crate) fn report_7503(&self, s: &mut RemoteSettings7503) {
        if let Some([min_range, max_range, min_depth, max_depth, tilt]) = self.detection_filter {
            s.bottom_filter_min_range_m = min_range as f32;
            s.bottom_filter_max_range_m = max_range as f32;
            s.bottom_filter_min_depth_m = min_depth as f32;
            s.bottom_filter_max_depth_m = max_depth as f32;
            s.depth_gate_tilt_rad = tilt as f32;
        }
        if let Some([envelope, shading]) = self.envelope {
            s.tx_pulse_envelope = envelope as u32;
            s.tx_pulse_envelope_parameter = shading as f32;
        }
        if let Some([vertical, horizontal]) = self.steering {
            s.projector_steer_vertical_rad = vertical as f32;
            s.projector_steer_horizontal_rad = horizontal as f32;
        }
        if let Some([vertical, horizontal]) = self.widths {
            s.projector_beam_width_vertical_rad = vertical as f32;
            s.projector_beam_width_horizontal_rad = horizontal as f32;
        }
        if let Some([roll, pitch]) = self.motion {
            s.receive_flags |= u32::from(roll != 0.0);
            s.transmit_flags |= u32::from(pitch != 0.0);
        }
        if let Some([sector, steering]) = self.coverage {
            s.coverage_angle_rad = sector as f32;
            s.rx_horizontal_steering_rad = steering as f32;
        }
        if let Some([_, width_s, offset_s]) = self.trigger_out {
            s.trigger_out_width_s = width_s;
            s.trigger_out_offset_s = offset_s;
        }
        if let Some([flags, velocity, _]) = self.sound_velocity
            && flags as u32 & 0b11 != 0
        {
            s.sound_velocity_m_per_s = velocity as f32;
        }
        if self.foreign_trigger && s.ping_state == RemoteSettings7503::PING_DISABLED {
            s.ping_state = RemoteSettings7503::PING_EXTERNAL_TRIGGER;
        }
    }

    /// Overrides fields of 7000 with stored settings.
    pub(crate) fn report_7000(&self, s: &mut SonarSettings7000) {
        if let Some([min_range, max_range, min_depth, max_depth, _]) = self.detection_filter {
            s.bottom_filter_min_range_m = min_range as f32;
            s.bottom_filter_max_range_m = max_range as f32;
            s.bottom_filter_min_depth_m = min_depth as f32;
            s.bottom_filter_max_depth_m = max_depth as f32;
        }
    }
}
