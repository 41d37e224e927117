//! Synthetic aperture in a replay: back-projects every ping onto a patch of the world, using the trajectory of the ping plan.
//!
//! All elements of the arrays in `[sonar.beams.synthetic_aperture]` contribute ([`BackProjection`]). Rows run north to south and columns
//! west to east, all at one depth.

use glam::DVec3;

use crate::io::record::synthetic_aperture::Patch;
use echotank_config::spec::{SonarSpec, SyntheticApertureSpec};
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_imaging::beam::RowLimits;
use echotank_imaging::beam::backproject::BackProjection;
use echotank_ping::plan;

/// Synthetic-aperture image of one sonar.
pub(crate) struct SyntheticAperture {
    spec: SyntheticApertureSpec,
    projection: BackProjection,
    pings: u64,
    /// Platform positions at the first and last ping.
    ends_m: Option<(DVec3, DVec3)>,
}

impl SyntheticAperture {
    /// Creates the image; `None` if the sonar has no synthetic aperture configured.
    pub(crate) fn new(sonar: &SonarSpec, sound_speed_m_per_s: f64) -> Option<Self> {
        let spec = sonar.beams.synthetic_aperture.clone()?;
        let limits = RowLimits {
            sample_rate_hz: sonar.receiver.sample_rate_hz,
            samples: plan::max_samples(sonar, sound_speed_m_per_s),
            pulse_s: sonar.limits.pulse_duration_s.1,
        };
        let (columns, rows) = spec.size();
        let point = |row: usize, column: usize| {
            DVec3::new(
                spec.north_m.1 - (row as f64 + 0.5) * spec.cell_m,
                spec.east_m.0 + (column as f64 + 0.5) * spec.cell_m,
                spec.down_m,
            )
        };
        let points = (0..rows)
            .flat_map(|row| (0..columns).map(move |column| (row, column)))
            .map(|(row, column)| point(row, column))
            .collect();
        let weighting = sonar.beams.weighting;
        Some(Self {
            projection: BackProjection::new(points, limits, &sonar.pulse, weighting),
            spec,
            pings: 0,
            ends_m: None,
        })
    }

    pub(crate) fn push(&mut self, sonar: &SonarSpec, plan: &PingPlan, output: &PingOutput) {
        for &array in &self.spec.arrays {
            let receive = &sonar.receive[array];
            let transmit = &sonar.transmit[receive.transmit];
            self.projection
                .add(plan, transmit, receive, &output.elements[array]);
        }
        let at_m = plan.segments.first().map_or(DVec3::ZERO, |s| s.position_m);
        let first_m = self.ends_m.map_or(at_m, |(first, _)| first);
        self.ends_m = Some((first_m, at_m));
        self.pings += 1;
    }

    /// Image with its extent and track; `None` without pings.
    pub(crate) fn finish(self) -> Option<Patch> {
        let (first_m, last_m) = self.ends_m?;
        let (columns, rows) = self.spec.size();
        Some(Patch {
            columns,
            rows,
            north_m: self.spec.north_m.1,
            west_m: self.spec.east_m.0,
            down_m: self.spec.down_m,
            cell_m: self.spec.cell_m,
            pings: self.pings,
            track_m: first_m.distance(last_m),
            image: self.projection.image().collect(),
        })
    }
}
