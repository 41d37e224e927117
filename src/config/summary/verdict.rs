//! Findings: what a valid configuration does otherwise than is probably meant, each with a remedy. `check` ends in them.

use std::f64::consts::PI;

use glam::DVec3;

use super::super::spec::*;
use super::rates::bytes_per_s;
use super::{Derived, mbit_per_s};
use crate::check::culling::response;
use crate::check::density::{SCATTERERS_PER_CELL, in_cell};
use echotank_core::ping::Side;

/// Level of the other side of a side-scan line from which on its echoes show, as energy: -10 dB.
const MIRRORED: f64 = 0.1;
/// Directions of a line's side that are compared with their mirror images.
const DIRECTIONS: usize = 60;
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
    // d (1 + sin of the outermost beam) < lambda keeps the first grating lobe outside the visible region.
    let reach = 1.0 + (fan.sector_rad / 2.0).sin();
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

fn link(sonar: &SonarSpec, d: &Derived, output: &OutputSpec) -> Option<Finding> {
    let all = bytes_per_s(sonar, d, output).iter().sum();
    let (link, limit_mbit_per_s, remedy) = match output {
        OutputSpec::Xtf(_) | OutputSpec::Sigmf(_) | OutputSpec::Wav(_) => return None,
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
