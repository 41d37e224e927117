//! Leaves out incoherent reflected echoes that hardly change what arrives at their range.
//!
//! An echo is kept with probability p, and its pressure is divided by sqrt(p), so that the mean intensity is unchanged (Horvitz and Thompson 1952). With A the
//! echo's amplitude at an array, pattern included, and A_0 that of the direct echoes that arrive with it,
//!
//! ```text
//! p = min(1, 2 A / A_0),    A_0^2 = sum A_i^4 / sum A_i^2 over the direct echoes of the range
//! ```
//!
//! Probabilities in proportion to pressure give the least variance for a number of echoes (Neyman 1934). Thinning adds sum(A^4 / p) / (sum A^2)^2 to the relative
//! variance of the intensity of a resolution cell. With n echoes of a pair and n direct ones, and x = A / A_0 < 1/2, that is x^3 / (2 n (1 + x^2)^2), which is
//! at most 1 / (25 n): far less than what the direct echoes alone have, 1 / n. Where nothing arrives directly, all echoes are kept.
//!
//! A pair of legs and its reverse are kept together, so that they still add in phase. The largest p of all arrays and of both orders counts.

use glam::DVec3;

use echotank_core::scene::{Footprint, LawCurve, ScatterLaw, Scatterers};

/// Bins of half the path.
const BINS: usize = 256;
/// Scatterers that are looked at.
const SAMPLES: usize = 8192;
/// Probability over the relative amplitude.
const KEPT: f64 = 2.0;
/// Least probability.
const LEAST: f64 = 1.0 / 256.0;

/// A pair of legs to a scatterer.
#[derive(Clone, Copy)]
pub(crate) struct Echo {
    /// Where the transmitter and the receiver see the scatterer.
    pub at_m: [DVec3; 2],
    /// Its normals there.
    pub normals: [[f32; 3]; 2],
    /// Magnitude of its strength with all coefficients.
    pub strength: f64,
    pub law: ScatterLaw,
}

/// Amplitudes of the direct echoes of a ping.
#[derive(Default)]
pub(crate) struct ImageThinning {
    /// By footprint and bin.
    direct: Vec<[f64; BINS]>,
    sums: Vec<[[f64; 2]; BINS]>,
    per_m: f64,
}

impl ImageThinning {
    /// Looks at the direct echoes of the first scatterers of lists, in their own places. A list with a curve has the law of that curve.
    pub(crate) fn look(
        &mut self,
        areas: &[Footprint],
        lists: &[(&Scatterers, usize, Option<&LawCurve>)],
    ) {
        let farthest_m = areas.iter().map(|area| area.max_range_m);
        self.per_m = BINS as f64 / farthest_m.fold(1.0, f64::max);
        self.sums.clear();
        self.sums.resize(areas.len(), [[0.0; 2]; BINS]);
        for &(scatterers, count, own) in lists {
            let curve = own.or(scatterers.curve.as_deref());
            let step = count.div_ceil(SAMPLES).max(1);
            for i in (0..count).step_by(step) {
                if is_single(scatterers, i) {
                    continue;
                }
                let echo = Echo {
                    at_m: [scatterers.position_m(i); 2],
                    normals: [scatterers.normal[i]; 2],
                    strength: scatterers.strength[i].norm(),
                    law: own.map_or(scatterers.law[i], |_| ScatterLaw::Curve),
                };
                for (area, sums) in areas.iter().zip(&mut self.sums) {
                    if let Some((half_m, amplitude)) = received(area, &echo, curve)
                        && let Some(sums) = sums.get_mut((half_m * self.per_m) as usize)
                    {
                        let intensity = step as f64 * amplitude * amplitude;
                        sums[0] += intensity * amplitude * amplitude;
                        sums[1] += intensity;
                    }
                }
            }
        }
        self.direct.clear();
        let amplitude = |[squares, sum]: [f64; 2]| match sum > 0.0 {
            true => (squares / sum).sqrt(),
            false => 0.0,
        };
        self.direct
            .extend(self.sums.iter().map(|sums| sums.map(amplitude)));
    }

    /// Probability with which an echo is kept.
    pub(crate) fn share(&self, areas: &[Footprint], echo: &Echo, curve: Option<&LawCurve>) -> f64 {
        let mut most = LEAST;
        for (area, direct) in areas.iter().zip(&self.direct) {
            if let Some((half_m, amplitude)) = received(area, echo, curve) {
                let bin = (half_m * self.per_m) as usize;
                let direct = direct.get(bin).copied().unwrap_or(0.0);
                if KEPT * amplitude >= direct {
                    return 1.0;
                }
                most = most.max(KEPT * amplitude / direct);
            }
        }
        most
    }
}

/// Whether a scatterer is not one of many: a point, or a target stronger than the ground.
pub(crate) fn is_single(scatterers: &Scatterers, i: usize) -> bool {
    scatterers.law[i] == ScatterLaw::Point || scatterers.loud[i] > 1.0
}

/// Half the path and the amplitude of an echo at an array, but for factors that all echoes of its range share. None behind a baffle.
fn received(area: &Footprint, echo: &Echo, curve: Option<&LawCurve>) -> Option<(f64, f64)> {
    let [out_m, back_m] = echo.at_m.map(|at_m| at_m - area.apex_m);
    let (out_range_m, back_range_m) = (out_m.length(), back_m.length());
    let [sent, heard] = &area.faces;
    if !sent.may_face(out_m.dot(sent.normal), out_range_m)
        || !heard.may_face(back_m.dot(heard.normal), back_range_m)
    {
        return None;
    }
    let [a, b, c, d] = &area.sides;
    let below = |axis: DVec3, knee: f64, ray_m: DVec3, range_m: f64| {
        (ray_m.dot(axis).abs() / (range_m * knee)).max(1.0)
    };
    let below = below(a.axis, a.knee, out_m, out_range_m)
        * below(b.axis, b.knee, out_m, out_range_m)
        * below(c.axis, c.knee, back_m, back_range_m)
        * below(d.axis, d.knee, back_m, back_range_m);
    let facing_out = facing(echo.normals[0], out_m, out_range_m);
    let facing_back = facing(echo.normals[1], back_m, back_range_m);
    let law = law_factor(echo.law, curve, [facing_out, facing_back]);
    let amplitude = echo.strength * law / (below * out_range_m * back_range_m);
    Some((0.5 * (out_range_m + back_range_m), amplitude))
}

/// Cosine of the incidence of a ray from the sonar.
pub(crate) fn facing(normal: [f32; 3], ray_m: DVec3, range_m: f64) -> f64 {
    (-DVec3::from(normal.map(f64::from)).dot(ray_m) / range_m).clamp(0.0, 1.0)
}

/// Factor of a law on the pressure, from the cosines of the incidence of the transmit and the receive leg.
pub(crate) fn law_factor(law: ScatterLaw, curve: Option<&LawCurve>, [out, back]: [f64; 2]) -> f64 {
    match law {
        ScatterLaw::Point | ScatterLaw::Water => 1.0,
        ScatterLaw::Lambert => (out * back).sqrt(),
        ScatterLaw::LambertOneWay => out,
        ScatterLaw::Curve => curve.map_or(0.0, |curve| {
            curve.half(out.sqrt()) * curve.half(back.sqrt())
        }),
    }
}
