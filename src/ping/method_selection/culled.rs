//! What a floor of the patterns leaves out of a ping's samples: a bound, window by window.
//!
//! In: a sonar, a ping's plan and scatterers. Out: floors, each with its error and what it keeps.
//!
//! What lies below the floor is not at hand (nobody gathers it), so it is predicted: the ground is taken for flat, with the law, the density and the
//! attitude of the ping. That gives each window's mean energy and that of what it is short of. Echoes have random phases, so both fluctuate, and the worst of
//! many windows counts: the short part may be loud where the whole is weak. For Gaussian samples the short part is s of the whole (its share of the
//! energy), and a rest that does not depend on the whole, of mean energy s (1 - s):
//!
//! ```text
//! error <= s + sqrt(s (1 - s) R),  P(energy of the rest over that of the whole, each over its mean, > R) <= (4 R/(1 + R)^2)^n
//! ```
//!
//! by Chernoff's bound for two gamma variables of shape n, the independent samples of a window: no more than band times time, and no more than scatterers
//! make them. Beside windows louder than themselves errors are counted against the ping's mean, which is weaker than the contract: a floor that kept
//! the windows of a side-scan's water column to it would keep the whole disc of ground around the sonar.

use std::sync::Arc;

use crate::method_selection::echo_statistics::{Shares, kept_shares};
use crate::method_selection::{Culling, Memo, Scene, fades};
use echotank_config::spec::SonarSpec;
use echotank_core::frames::{angles_from_rotation, rotation_from_angles};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::MIN_WINDOW;
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_synthesis::echo::culling::{Ground, LeftOut, Rings, left_out_share};

/// What of the tolerance culling may leave out.
const CULL_SHARES: [f64; 2] = [0.5, 0.2];
/// Floors are tried in steps of this, dB, and none below the least.
const CULL_STEP_DB: f64 = 2.0;
const MIN_CULL_DB: f64 = -110.0;
/// Where what is left out is looked at: from near the first bottom return to grazing.
const INCIDENCES_DEG: [f64; 4] = [20.0, 45.0, 70.0, 85.0];
/// What a platform that turns on, over ground that is not flat, leaves out more.
const UNEVEN: f64 = 1.5;
/// A ping's mean energy is no less than this of what is predicted.
const MIN_MEAN: f64 = 0.8;
/// Beyond the floor that they were gathered with, scatterers are as dense as just above it, within so many dB: a thinned seabed has fewer, the farther
/// a side lobe lies below the main lobe.
const NEAR_FLOOR_DB: f64 = 10.0;
/// Quantisation of roll and pitch (2 degrees) and of height (3 %) for the level histograms. Finer steps would need more histograms.
const ATTITUDE_STEP_RAD: f64 = std::f64::consts::PI / 90.0;
const HEIGHTS_PER_DOUBLING: f64 = 24.0;
/// Maximum number of stored attitudes and heights. The histograms of each take 0.4 MB for each array.
const MAX_GROUNDS: usize = 32;
/// Mean square over squared mean of a scatterer's energy: exponential, as speckle is.
const SPECKLE: f64 = 2.0;

/// Floors of the patterns, the configuration's own first. `of` elements of a line are one.
pub(super) fn floors(scene: &Scene, of: usize, memo: &Memo) -> Vec<Culling> {
    let spec = scene.spec;
    let Some(own_db) = spec.model.cull_db else {
        return vec![Culling {
            db: None,
            error: 0.0,
            of: Shares::ALL,
        }];
    };
    let seabed = Seabed::new(scene, own_db, memo);
    let wavelength_m = scene.plan.sound_speed_m_per_s / scene.plan.pulse.center_frequency_hz;
    let level = |db: f64| {
        let arrays = spec.receive.iter().flat_map(|array| {
            let transmit = &spec.transmit[array.transmit];
            INCIDENCES_DEG.map(|deg| {
                left_out_share(transmit, array, wavelength_m, db, deg.to_radians()).sqrt()
            })
        });
        arrays.fold(0.0, f64::max)
    };
    let level = |db: f64| {
        Memo::of(
            &memo.left_out,
            Memo::MAX_ENTRIES,
            (of, db.to_bits()),
            || level(db),
        )
    };
    let left_out = |db: f64| UNEVEN * level(db).max(seabed.worst(db));
    let mut dbs = vec![own_db];
    if spec.synthesis.auto.cull {
        for share in CULL_SHARES {
            let most = share * spec.synthesis.tolerance;
            let mut db = own_db;
            while db > MIN_CULL_DB && left_out(db) > most {
                db -= CULL_STEP_DB;
            }
            if !dbs.contains(&db) {
                dbs.push(db);
            }
        }
    }
    let floors: Vec<Option<f64>> = dbs.iter().copied().map(Some).collect();
    let near_db = own_db + NEAR_FLOOR_DB;
    let with_near: Vec<_> = floors.iter().copied().chain([Some(near_db)]).collect();
    let mut kept = kept_shares(spec, scene.plan, scene.scatterers, &with_near);
    let near = kept.pop().unwrap_or(Shares::ALL);
    let own = kept[0];
    let own_m2 = seabed.above_m2(own_db);
    let near_m2 = (own_m2 - seabed.above_m2(near_db)).max(f64::MIN_POSITIVE);
    // Of the scatterers at hand, per square metre just above the floor.
    let per_m2 = (own.kept - near.kept).max(0.0) / near_m2;
    // Below the floor that they were gathered with scatterers are predicted too.
    let shares = dbs.iter().zip(kept).map(|(&db, at_hand)| {
        let more_m2 = (seabed.above_m2(db) - own_m2).max(0.0);
        let grown = 1.0 + per_m2 * more_m2 / own.kept.max(f64::MIN_POSITIVE);
        Shares {
            transmit_leg: at_hand.transmit_leg.max(own.transmit_leg * grown),
            kept: at_hand.kept.max(own.kept * grown),
        }
    });
    dbs.iter()
        .zip(shares)
        .map(|(&db, of)| Culling {
            db: Some(db),
            error: left_out(db),
            of,
        })
        .collect()
}

/// The ground of a ping, predicted for every array.
struct Seabed {
    rings: Arc<Vec<Rings>>,
    /// Of each array.
    elements: Vec<usize>,
    /// Scatterers to the square metre.
    density_per_m2: f64,
    /// Band times time of a window, and one.
    samples: f64,
    /// ln of how many windows there are, of all elements.
    looks: f64,
}

impl Seabed {
    fn new(scene: &Scene, own_db: f64, memo: &Memo) -> Self {
        let Scene {
            spec,
            plan,
            scatterers,
            ..
        } = *scene;
        let rate_hz = spec.receiver.sample_rate_hz;
        let window_s = plan.pulse.duration_s.max(MIN_WINDOW / rate_hz);
        let elements: usize = spec.receive.iter().map(|array| array.elements).sum();
        let windows = (plan.window_s(rate_hz) / window_s).ceil().max(2.0);
        let kept = kept_shares(spec, plan, scatterers, &[Some(own_db)]);
        let heard = kept[0].kept * scene.count as f64;
        let mut seabed = Self {
            rings: rings(spec, plan, scatterers, window_s, memo),
            elements: spec.receive.iter().map(|array| array.elements).collect(),
            density_per_m2: 0.0,
            samples: 1.0 + plan.pulse.bandwidth_hz * window_s,
            looks: (windows * elements as f64).ln(),
        };
        seabed.density_per_m2 = heard / seabed.above_m2(own_db).max(f64::MIN_POSITIVE);
        seabed
    }

    /// Ground that an element hears above the floor, mean of all elements: as pairs of scatterers and elements are counted.
    fn above_m2(&self, db: f64) -> f64 {
        let arrays = self.rings.iter().zip(&self.elements);
        let (sum, elements) = arrays.fold((0.0, 0.0), |(sum, all), (rings, &elements)| {
            let elements = elements as f64;
            (sum + rings.above_m2(db) * elements, all + elements)
        });
        sum / elements
    }

    /// Relative error of the worst window's samples.
    fn worst(&self, db: f64) -> f64 {
        let windows = self.rings.iter().flat_map(|rings| rings.left_out(db));
        windows
            .map(|window| self.error(&window))
            .fold(0.0, f64::max)
    }

    fn error(&self, window: &LeftOut) -> f64 {
        if window.left_out <= 0.0 {
            return 0.0;
        }
        // A single scatterer makes one.
        let independent = |per_m2: f64| {
            let from = per_m2 * self.density_per_m2 / SPECKLE;
            from.min(self.samples).max(1.0)
        };
        let (all, left_out) = (
            independent(window.from_all),
            independent(window.from_left_out),
        );
        // Beside what is louder than this window.
        let beside = (fades::worst_peak(self.looks, left_out) * window.left_out / MIN_MEAN).sqrt();
        let share = window.left_out / window.all;
        let ratio = fades::worst_ratio(self.looks, all.min(left_out));
        let alone = share + (share * (1.0 - share) * ratio).sqrt();
        alone.min(beside)
    }
}

/// Level histograms of every array from the first return on, in the attitude and height of the ping, rounded to [`ATTITUDE_STEP_RAD`] and
/// [`HEIGHTS_PER_DOUBLING`].
fn rings(
    spec: &SonarSpec,
    plan: &PingPlan,
    scatterers: &Scatterers,
    window_s: f64,
    memo: &Memo,
) -> Arc<Vec<Rings>> {
    let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
    let pose = plan.trajectory.pose_at(0.0);
    let of_ground: Vec<usize> = (0..scatterers.len())
        .filter(|&i| scatterers.law[i] != ScatterLaw::Point)
        .collect();
    let down_m = of_ground.iter().map(|&i| scatterers.down_m[i]).sum::<f64>();
    let mean_down_m = down_m / of_ground.len().max(1) as f64;
    let (roll_rad, pitch_rad, _) = angles_from_rotation(pose.world_from_body);
    // Adding 0 turns -0 into 0, which has other bits.
    let [roll, pitch] = [roll_rad, pitch_rad].map(|a| (a / ATTITUDE_STEP_RAD).round() + 0.0);
    let world_from_body =
        rotation_from_angles(roll * ATTITUDE_STEP_RAD, pitch * ATTITUDE_STEP_RAD, 0.0);
    let octaves = libm::log2((mean_down_m - pose.position_m.z).max(wavelength_m));
    let octaves = (octaves * HEIGHTS_PER_DOUBLING).round() / HEIGHTS_PER_DOUBLING;
    let curve = scatterers.curve.as_deref();
    let law = |cos: f64| match curve {
        Some(curve) => curve.half(cos.max(0.0).sqrt().min(1.0)).powi(4),
        None => cos * cos,
    };
    let c = plan.sound_speed_m_per_s;
    let farthest_m = 0.5 * plan.window_s(spec.receiver.sample_rate_hz) * c;
    let window_m = 0.5 * window_s * c;
    let key = [
        roll,
        pitch,
        octaves,
        farthest_m,
        window_m,
        wavelength_m,
        plan.absorption_db_per_m,
    ];
    Memo::of(&memo.rings, MAX_GROUNDS, key.map(f64::to_bits), || {
        let arrays = spec.receive.iter().map(|array| {
            let transmit = &spec.transmit[array.transmit];
            let arm_m = world_from_body * transmit.mounting.position_m;
            let ground = Ground {
                world_from_body,
                height_m: libm::exp2(octaves) - arm_m.z,
                farthest_m,
                absorption_db_per_m: plan.absorption_db_per_m,
                law,
                window_m,
            };
            Rings::new(transmit, array, wavelength_m, &ground)
        });
        Arc::new(arrays.collect())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against draws of windows: n samples of the whole, of which a share s is left out, none of 1000 above, and not ten times too high.
    #[test]
    fn of_a_thousand_windows_none_leaves_out_more_than_is_predicted() {
        let mut state = 1u64;
        let mut even = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            ((state >> 11) as f64 + 0.5) / (1u64 << 53) as f64
        };
        let mut gauss = || (-even().ln()).sqrt() * (std::f64::consts::TAU * even()).cos();
        for (n, share) in [(4, 0.01_f64), (15, 0.1), (15, 1e-4), (60, 0.5), (2, 1e-3)] {
            let mut worst = 0.0f64;
            for _ in 0..1000 {
                let (mut short, mut whole) = (0.0_f64, 0.0_f64);
                for _ in 0..2 * n {
                    let (left, kept) = (share.sqrt() * gauss(), (1.0 - share).sqrt() * gauss());
                    short += left * left;
                    whole += (left + kept) * (left + kept);
                }
                worst = worst.max((short / whole).sqrt());
            }
            let seabed = Seabed {
                rings: Arc::default(),
                elements: Vec::new(),
                density_per_m2: 1.0,
                samples: n as f64,
                looks: 1000f64.ln(),
            };
            // So much louder than the rest of the ping that only itself counts.
            let window = LeftOut {
                all: 1e9,
                left_out: 1e9 * share,
                from_all: 1e9,
                from_left_out: 1e9,
            };
            // As it is promised.
            let said = UNEVEN * seabed.error(&window);
            println!("{n} samples, share {share}: {said:.3e} said, {worst:.3e} at worst");
            assert!(
                worst <= said && said < 10.0 * worst,
                "{n} {share}: {said} {worst}"
            );
        }
    }
}
