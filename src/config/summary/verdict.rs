//! Findings: what a valid configuration does otherwise than is probably meant, each with a remedy. `check` ends in them.

use std::f64::consts::PI;

use glam::DVec3;

use super::super::spec::*;
use super::rates::bytes_per_s;
use super::{Derived, mbit_per_s};
use crate::check::culling::response;
use crate::check::density::{SCATTERERS_PER_CELL, in_cell};
use echotank_core::arrays::ReceiverFilter;
use echotank_core::ping::Side;
use echotank_core::pulse::Pulse;

/// Level of the other side of a side-scan line from which on its echoes show, as energy: -10 dB.
const MIRRORED: f64 = 0.1;
/// Directions of a line's side that are compared with their mirror images.
const DIRECTIONS: usize = 60;
/// Share of a pulse's energy beyond half the sample rate from which on its aliases show beside speckle: -30 dB.
const ALIASED: f64 = 1e-3;
/// The receiver filter leaves room for the Doppler of a platform as fast as this, m/s; so do sample rates.
const FASTEST_M_PER_S: f64 = 10.0;
/// Gigabit Ethernet.
const LINK_MBIT_PER_S: f64 = 1000.0;
/// Bits of one byte on a serial line.
const BITS_PER_BYTE: f64 = 10.0;

/// Kinds of findings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FindingKind {
    /// Pings take longer than their period.
    TooSlow,
    /// No method keeps the tolerance.
    Inaccurate,
    /// No seabed in the footprint.
    NoSeabed,
    /// Too few scatterers in a resolution cell.
    SpeckleUndersampled,
    /// A side-scan line receives the other side too.
    SidesMirrored,
    /// Steered beams have grating lobes.
    GratingLobes,
    /// Part of the pulse's spectrum is sampled at other frequencies.
    AliasedBand,
    /// The strongest samples exceed the full scale of the converter or of an output.
    Saturates,
    /// An output has more data than its link carries.
    RecordsExceedLink,
}

impl FindingKind {
    /// Name in the verdict.
    pub fn name(self) -> &'static str {
        match self {
            Self::TooSlow => "too slow",
            Self::Inaccurate => "inaccurate",
            Self::NoSeabed => "sees no seabed",
            Self::SpeckleUndersampled => "speckle undersampled",
            Self::SidesMirrored => "sides mirrored",
            Self::GratingLobes => "grating lobes",
            Self::AliasedBand => "aliased band",
            Self::Saturates => "saturates",
            Self::RecordsExceedLink => "records exceed the link",
        }
    }
}

/// A finding.
#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    /// Its kind.
    pub kind: FindingKind,
    /// What is so, with numbers.
    pub text: String,
    /// What to change.
    pub remedy: String,
}

/// Findings of the configuration alone: those of methods, cost and scene need a ping.
pub fn findings(rig: &RigSpec) -> Vec<Finding> {
    let c = rig.medium.sound_speed_m_per_s;
    let mut found = Vec::new();
    let scene = &rig.scene;
    if scene.seabed.is_none() && scene.points.is_none() && scene.targets.is_none() {
        found.push(Finding {
            kind: FindingKind::NoSeabed,
            text: "the scene is empty: there is only noise".to_owned(),
            remedy: "add [scene.seabed], scene.points or scene.targets".to_owned(),
        });
    }
    for sonar in &rig.sonars {
        found.extend(speckle(rig, sonar, c));
        found.extend(
            sonar
                .beams
                .lines
                .iter()
                .filter_map(|line| mirrored(sonar, line, c)),
        );
        found.extend(grating(sonar, c));
        found.extend(aliased(sonar, c));
        let d = Derived::of(sonar, c);
        let outputs = sonar.outputs.iter();
        found.extend(outputs.filter_map(|output| link(sonar, &d, output)));
    }
    found
}

fn speckle(rig: &RigSpec, sonar: &SonarSpec, c: f64) -> Option<Finding> {
    let seabed = rig.scene.seabed.as_ref()?;
    let Density::PerM2(per_m2) = seabed.density else {
        return None;
    };
    let depth_m = match seabed.shape {
        SeabedShape::Plane { depth_m, .. } => Some(depth_m),
        _ => None,
    };
    let cell = in_cell(sonar, c, depth_m, per_m2);
    // Without speckle each scatterer is a reflector of its own.
    if !seabed.speckle || cell >= SCATTERERS_PER_CELL {
        return None;
    }
    Some(Finding {
        kind: FindingKind::SpeckleUndersampled,
        text: format!(
            "{}: {cell:.2} scatterers in a resolution cell in the middle of the range; speckle needs {SCATTERERS_PER_CELL}",
            sonar.name
        ),
        remedy: format!(
            "scene.seabed.density = \"auto\", or density_per_m2 of at least {:.0}",
            (per_m2 * SCATTERERS_PER_CELL / cell).ceil()
        ),
    })
}

/// The energy of the two-way pattern towards the other side against that towards the line's own, over all depressions.
fn mirrored(sonar: &SonarSpec, line: &LineSpec, c: f64) -> Option<Finding> {
    let array = &sonar.receive[line.array];
    let transmit = &sonar.transmit[array.transmit];
    let wavelength_m = c / sonar.pulse.center_frequency_hz;
    let energy = |sign: f64| -> f64 {
        let of = (0..DIRECTIONS).map(|k| {
            let depression_rad = 0.5 * PI * (k as f64 + 0.5) / DIRECTIONS as f64;
            let (down, across) = libm::sincos(depression_rad);
            let ray = DVec3::new(0.0, sign * across, down);
            let leg = |pattern, body_from_array: glam::DQuat| {
                response(pattern, wavelength_m, body_from_array.inverse() * ray)
            };
            leg(&transmit.pattern, transmit.mounting.body_from_array)
                * leg(&array.element_pattern, array.mounting.body_from_array)
        });
        of.map(|level| level * level).sum()
    };
    let side = match line.side {
        Side::Port => -1.0,
        Side::Starboard => 1.0,
    };
    let ratio = energy(-side) / energy(side).max(f64::MIN_POSITIVE);
    (ratio > MIRRORED).then(|| Finding {
        kind: FindingKind::SidesMirrored,
        text: format!(
            "{}: the {} line receives the other side at {:.0} dB",
            sonar.name,
            line.side.word(),
            10.0 * ratio.log10()
        ),
        remedy: format!(
            "pattern = \"rectangle\" with length_m, width_m and baffled = true for \"{}\" and \"{}\", turned to their side by roll_deg",
            sonar.transmit_names[array.transmit], sonar.receive_names[line.array]
        ),
    })
}

fn grating(sonar: &SonarSpec, c: f64) -> Option<Finding> {
    let fan = sonar.beams.fan.as_ref()?;
    let wavelength_m = c / sonar.pulse.center_frequency_hz;
    let array = &sonar.receive[fan.array];
    // d (1 + sin of the outermost beam) < lambda keeps the first grating lobe outside the visible region. On an arc the outermost elements of a beam
    // look past it by half the aperture.
    let outermost_rad = match array.radius_m {
        None => fan.sector_rad / 2.0,
        Some(_) => fan.form.aperture_rad / 2.0,
    };
    let reach = 1.0 + outermost_rad.sin();
    (array.spacing_m * reach > wavelength_m).then(|| Finding {
        kind: FindingKind::GratingLobes,
        text: format!(
            "{}: the fan's elements lie {:.2} wavelengths apart; its outer beams have grating lobes",
            sonar.name,
            array.spacing_m / wavelength_m
        ),
        remedy: format!(
            "spacing_m of at most {:.5} for \"{}\", or a smaller sector_deg",
            (1e5 * wavelength_m / reach).floor() / 1e5,
            sonar.receive_names[fan.array]
        ),
    })
}

fn aliased(sonar: &SonarSpec, c: f64) -> Option<Finding> {
    if sonar.receiver.filter != ReceiverFilter::None {
        return None;
    }
    let doppler_hz = 2.0 * FASTEST_M_PER_S / c * sonar.pulse.center_frequency_hz;
    let share_at = |rate_hz: f64| energy_beyond(&sonar.pulse, 0.5 * rate_hz - doppler_hz);
    let rate_hz = sonar.receiver.sample_rate_hz;
    let share = share_at(rate_hz);
    if share <= ALIASED {
        return None;
    }
    let mut enough_hz = rate_hz;
    while share_at(enough_hz) > ALIASED {
        enough_hz *= 1.1;
    }
    Some(Finding {
        kind: FindingKind::AliasedBand,
        text: format!(
            "{}: without a receiver filter, {:.1} % of the energy of the pulse lies beyond half the sample rate and returns at other frequencies",
            sonar.name,
            100.0 * share
        ),
        remedy: format!(
            "rx_filter = \"fir\" in [sonar.receiver], a longer pulse.taper, or sample_rate_khz of at least {:.0}",
            (1e-3 * enough_hz).ceil()
        ),
    })
}

/// Share of a pulse's energy at more than `limit_hz` from its centre. Far outside the band the spectrum is that of the two ends of the pulse, where the
/// instantaneous frequency is `-B/2` and `B/2`: at `f` from it `1/(2 pi f)`, times `cos(pi f t)/(1 - (2 f t)^2)` for a flank of length `t`.
fn energy_beyond(pulse: &Pulse, limit_hz: f64) -> f64 {
    let half_band_hz = 0.5 * pulse.bandwidth_hz;
    let flank_s = 0.5 * pulse.taper * pulse.duration_s;
    // Energy from `from_hz` to infinity, with f = from/u: du from 0 to 1.
    let tail = |from_hz: f64| -> f64 {
        let steps = 4000;
        let density = |k: i32| {
            let u = (f64::from(k) + 0.5) / f64::from(steps);
            let x = from_hz / u * flank_s;
            // At 2 x = 1 the quotient is pi/4.
            let beyond = 1.0 - 4.0 * x * x;
            let flank = match beyond.abs() < 1e-9 {
                true => 0.25 * PI,
                false => libm::cos(PI * x) / beyond,
            };
            flank * flank
        };
        (0..steps).map(density).sum::<f64>() / f64::from(steps) / (4.0 * PI * PI * from_hz)
    };
    let (near_hz, far_hz) = (limit_hz - half_band_hz, limit_hz + half_band_hz);
    if near_hz <= 0.0 {
        return 1.0;
    }
    // Mean square of the envelope: 3/8 on flanks.
    let energy_s = pulse.duration_s * (1.0 - 0.625 * pulse.taper);
    (2.0 * (tail(near_hz) + tail(far_hz)) / energy_s).min(1.0)
}

fn link(sonar: &SonarSpec, d: &Derived, output: &OutputSpec) -> Option<Finding> {
    let all = bytes_per_s(sonar, d, output).iter().sum();
    let (link, limit_mbit_per_s, remedy) = match output {
        OutputSpec::Xtf(_) | OutputSpec::Sigmf(_) | OutputSpec::Mcap(_) | OutputSpec::Wav(_) => {
            return None;
        }
        OutputSpec::Vita49(vita) => (
            "the output is paced to",
            mbit_per_s(vita.pace_bytes_per_s).min(LINK_MBIT_PER_S),
            "raise its pace, or send fewer elements",
        ),
        OutputSpec::Ping(PingProtocolSpec {
            serial: Some((_, baud)),
            ..
        }) => (
            "the serial line carries",
            f64::from(*baud) * 8.0 / BITS_PER_BYTE / 1e6,
            "a higher baud rate",
        ),
        _ => (
            "gigabit Ethernet carries",
            LINK_MBIT_PER_S,
            "fewer elements or beams, a lower sonar.receiver.sample_rate_khz",
        ),
    };
    let mbit_per_s = mbit_per_s(all);
    (mbit_per_s > limit_mbit_per_s).then(|| Finding {
        kind: FindingKind::RecordsExceedLink,
        text: format!(
            "{}: {mbit_per_s:.3} Mbit/s to a client that takes all records; {link} {limit_mbit_per_s:.3}",
            sonar.name
        ),
        remedy: format!(
            "{remedy}, or at most {:.2} pings/s",
            d.ping_rate_hz * limit_mbit_per_s / mbit_per_s
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::pulse::PulseKind;

    /// Energy of the pulse's discrete spectrum, sampled 32 times as densely as the limit.
    fn measured(pulse: &Pulse, limit_hz: f64) -> f64 {
        let rate_hz = 64.0 * limit_hz;
        let count = (pulse.duration_s * rate_hz).round() as usize;
        let bin_hz = 0.25 / pulse.duration_s;
        let bins = (limit_hz / bin_hz) as i64;
        let a: Vec<_> = (0..count)
            .map(|k| pulse.envelope((k as f64 + 0.5) / rate_hz))
            .collect();
        let total: f64 = a.iter().map(|a| a.norm_sqr()).sum::<f64>() / rate_hz;
        let within: f64 = (-bins..=bins)
            .map(|bin| {
                let f_hz = bin as f64 * bin_hz;
                let (mut re, mut im) = (0.0, 0.0);
                for (k, a) in a.iter().enumerate() {
                    let (sin, cos) = libm::sincos(2.0 * PI * f_hz * k as f64 / rate_hz);
                    re += a.re * cos + a.im * sin;
                    im += a.im * cos - a.re * sin;
                }
                (re * re + im * im) / (rate_hz * rate_hz) * bin_hz
            })
            .sum();
        1.0 - within / total
    }

    #[test]
    fn the_energy_beyond_a_limit_is_that_of_the_spectrum() {
        for (kind, bandwidth_hz, taper, limit_hz) in [
            (PulseKind::Cw, 0.0, 0.0, 5e3),
            (PulseKind::LfmUp, 10e3, 0.0, 8e3),
            (PulseKind::LfmDown, 10e3, 0.1, 8e3),
        ] {
            let pulse = Pulse {
                kind,
                center_frequency_hz: 100e3,
                bandwidth_hz,
                duration_s: 2e-3,
                taper,
            };
            let (got, want) = (energy_beyond(&pulse, limit_hz), measured(&pulse, limit_hz));
            println!("{bandwidth_hz} Hz, taper {taper}: {got:.2e}, {want:.2e}");
            assert!((0.6..1.7).contains(&(got / want)), "{got:e}, {want:e}");
        }
    }
}
