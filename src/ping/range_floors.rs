//! Pattern floors by range: what culling may leave out, window by window.
//!
//! In: a sonar without a configured culling level, a ping's plan and its scatterers. Out: [`RangeFloors`].
//!
//! Echoes from directions below a floor of the two-way pattern are left out. Where the main lobe meets the ground, the floor can be high. Windows in which
//! only side lobes do (before the main lobe reaches the ground, or where the ground rises beside the swath) are weaker and need a lower one. Each range
//! therefore has the highest floor with which culling leaves out [`LEFT_OUT`] of the tolerance at most in every window of a pulse length, relative to
//! the window or to a noise floor 55 dB below the strongest window.
//!
//! The energies of windows are estimated from a sample of the scatterers, by range and by level of the two-way pattern. An echo fills the window that
//! begins with it and the one that ends with it. Bins are half a window long, so the window from bin k on has E(k-1) + 2 E(k) + E(k+1), and each
//! bin may leave out a quarter of what the weakest of its three windows bears.
//!
//! Echoes have random phases, so the energies fluctuate: the part left out may be strong where the whole is weak. For Gaussian samples the part left out is
//! s of the whole (its share of the energy), and a rest that does not depend on the whole, of mean energy s (1 - s). Its error is at most
//! s + sqrt(s (1 - s) R) in all but the rarest windows, with the ratio R of [`fades::worst_ratio`].

use glam::{DMat3, DQuat, DVec3};

use echotank_config::spec::SonarSpec;
use echotank_core::ping::{PingPlan, RangeFloors};
use echotank_core::pulse::{FLOOR_BELOW_STRONGEST_DB, MIN_WINDOW};
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_synthesis::echo::levels::{Directivity, OneWay};

use crate::method_selection::fades;

/// Share of the tolerance that culling may leave out of a window.
pub(crate) const LEFT_OUT: f64 = 0.4;
/// Energies are estimated from a sample, and from the middle element.
const MARGIN: f64 = 2.0;
/// Scatterers are gathered from directions so far below the default floor, dB.
pub(crate) const GATHERED_BELOW_DB: f64 = 20.0;
/// Number of bins; longer pings have longer ones.
const BINS: usize = 256;
/// Steps of the two-way level, and what the last one holds and all below it.
const STEP_DB: f64 = 3.0;
const LEVELS: usize = 50;
/// Scatterers that are looked at: one for so many pairs of scatterer and element, within limits, and at least so many in each bin. Weak windows have few
/// scatterers, which are strong because the seabed is thinned there.
const PAIRS_PER_SAMPLE: usize = 256;
const SAMPLES: (usize, usize) = (2048, 8192);
const SAMPLES_PER_BIN: usize = 16;

/// Energies of one array, by range and level.
type Energies = [[f64; LEVELS]; BINS];

/// Room for the floors of a ping.
pub(crate) fn with_room() -> RangeFloors {
    RangeFloors {
        per_m: 0.0,
        levels: Vec::with_capacity(BINS),
    }
}

/// Finds the floors of pings. Keeps its tables, so that no ping allocates.
pub struct RangeFloorFinder {
    energies: Box<Energies>,
    /// Scatterers of the ground by bin, and how many of them one that is looked at stands for.
    counts: [usize; BINS],
    strides: [usize; BINS],
    /// By bin: energies of the scatterers that are looked at, each over the square of its level, and how many there are.
    unweighted: [(f64, f64); BINS],
}

impl Default for RangeFloorFinder {
    fn default() -> Self {
        Self {
            energies: vec![[0.0; LEVELS]; BINS]
                .into_boxed_slice()
                .try_into()
                .unwrap_or_else(|_| Box::new([[0.0; LEVELS]; BINS])),
            counts: [0; BINS],
            strides: [1; BINS],
            unweighted: [(0.0, 0.0); BINS],
        }
    }
}

impl RangeFloorFinder {
    /// Sets the floors of `plan`; none where the floor of the model is configured, or absent.
    pub fn find(&mut self, spec: &SonarSpec, plan: &mut PingPlan, scatterers: &Scatterers) {
        let mut floors = std::mem::take(&mut plan.range_floors);
        floors.levels.clear();
        if spec.synthesis.culls_by_window && plan.model.cull_db.is_some() && !scatterers.is_empty()
        {
            self.fill(spec, plan, scatterers, &mut floors);
        }
        plan.range_floors = floors;
    }

    fn fill(
        &mut self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        floors: &mut RangeFloors,
    ) {
        let look = Look::new(spec, plan, scatterers);
        floors.per_m = look.per_m;
        floors.levels.resize(BINS, f32::INFINITY);
        let allowed = LEFT_OUT / MARGIN * spec.synthesis.tolerance;
        let share = allowed * allowed / look.worst_ratio;
        for array in 0..spec.receive.len() {
            self.add_up(spec, plan, scatterers, array, &look);
            self.lower(share, &mut floors.levels);
        }
        // A bin without a sample may have scatterers.
        let levels = &mut floors.levels;
        for k in 1..BINS {
            if levels[k].is_infinite() {
                levels[k] = levels[k - 1];
            }
        }
    }

    /// Largest error of a window, of what lies below the level `cull_db` and was gathered.
    pub(crate) fn left_out(
        &mut self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        cull_db: f64,
    ) -> f64 {
        let look = Look::new(spec, plan, scatterers);
        let first_culled = ((-cull_db / STEP_DB) as usize).min(LEVELS);
        let mut worst = 0.0f64;
        for array in 0..spec.receive.len() {
            self.add_up(spec, plan, scatterers, array, &look);
            let all = Windows::of(&self.energies, 0);
            let left_out = Windows::of(&self.energies, first_culled);
            let noise = all.noise();
            for k in 0..BINS {
                let share = left_out.from(k) / all.from(k).max(noise).max(f64::MIN_POSITIVE);
                let rest = share * (1.0 - share) * look.worst_ratio;
                worst = worst.max(share + rest.sqrt());
            }
        }
        MARGIN * worst
    }

    /// Energies that the middle element of an array receives.
    fn add_up(
        &mut self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        array: usize,
        look: &Look,
    ) {
        let per_m = look.per_m;
        let array = &spec.receive[array];
        let transmit = &spec.transmit[array.transmit];
        let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
        let sent = Directivity::new(&transmit.pattern, wavelength_m);
        let received = Directivity::new(&array.element_pattern, wavelength_m);
        let one_way = OneWay::new(wavelength_m, plan.absorption_db_per_m);
        let pose = plan.trajectory.pose_at(0.0);
        let from_world = |of: DQuat| DMat3::from_quat((pose.world_from_body * of).inverse());
        let transmit_from_world = from_world(transmit.mounting.body_from_array);
        let array_from_world = from_world(array.mounting.body_from_array);
        let transmit_m = pose.point_m(transmit.mounting.position_m);
        let receive_m = pose.point_m(array.element_body_m(array.elements / 2));
        let bin_of = |i: usize| (half_path_m(scatterers, i, transmit_m) * per_m) as usize;
        self.counts.fill(0);
        for i in 0..scatterers.len() {
            if let Some(count) = self.counts.get_mut(bin_of(i)) {
                *count += 1;
            }
        }
        let used = self.counts.iter().filter(|count| **count > 0).count();
        let of_bin = (look.among / used.max(1)).max(SAMPLES_PER_BIN);
        for (stride, count) in self.strides.iter_mut().zip(&self.counts) {
            *stride = count.div_ceil(of_bin).max(1);
        }
        self.counts.fill(0);
        self.energies.fill([0.0; LEVELS]);
        self.unweighted.fill((0.0, 0.0));
        let curve = scatterers.curve.as_deref();
        for i in 0..scatterers.len() {
            let bin = bin_of(i);
            if bin >= BINS {
                continue;
            }
            let mut weight = 1.0;
            // Targets and points that are stronger than the ground are all looked at.
            if scatterers.loud[i] <= 1.0 {
                let number = self.counts[bin];
                self.counts[bin] += 1;
                if !number.is_multiple_of(self.strides[bin]) {
                    continue;
                }
                weight = self.strides[bin] as f64;
            }
            let out_m = scatterers.transmit_m(i) - transmit_m;
            let back_m = scatterers.position_m(i) - receive_m;
            let (out_range_m, back_range_m) = (out_m.length(), back_m.length());
            if out_range_m == 0.0 || back_range_m == 0.0 {
                continue;
            }
            let (out, back) = (out_m / out_range_m, back_m / back_range_m);
            let towards = |pattern: &Directivity, turn: &DMat3, ray: DVec3| {
                let u = *turn * ray;
                pattern.towards(u.x, u.y, u.z)
            };
            let level = towards(&sent, &transmit_from_world, out)
                * towards(&received, &array_from_world, back);
            let facing = |normal: [f32; 3], ray: DVec3| {
                (-DVec3::from(normal.map(f64::from)).dot(ray)).clamp(0.0, 1.0)
            };
            let facing_out = facing(scatterers.transmit_normal(i), out);
            let facing_back = facing(scatterers.normal[i], back);
            let law = match scatterers.law[i] {
                ScatterLaw::Point | ScatterLaw::Water => 1.0,
                ScatterLaw::Lambert => (facing_out * facing_back).sqrt(),
                ScatterLaw::LambertOneWay => facing_out,
                ScatterLaw::Curve => curve.map_or(0.0, |curve| {
                    curve.half(facing_out.sqrt()) * curve.half(facing_back.sqrt())
                }),
            };
            let loss = one_way.amplitude(out_range_m) * one_way.amplitude(back_range_m);
            let energy = (level * law * loss).powi(2) * scatterers.strength[i].norm_sqr();
            if energy > 0.0 {
                let tested = level.abs() * f64::from(scatterers.loud[i]);
                let step = (-20.0 / STEP_DB * libm::log10(tested)).max(0.0) as usize;
                self.energies[bin][step.min(LEVELS - 1)] += weight * energy;
                let (sum, number) = &mut self.unweighted[bin];
                *sum += energy / (tested * tested);
                *number += 1.0;
            }
        }
    }

    /// Lowers `floors` to what the array needs: at most `share` of the energy of any window is left out.
    fn lower(&self, share: f64, floors: &mut [f32]) {
        let windows = Windows::of(&self.energies, 0);
        let noise = windows.noise();
        let per_step = libm::exp10(0.1 * STEP_DB);
        let lowest = per_step.powi(1 - LEVELS as i32);
        for (k, energies) in self.energies.iter().enumerate() {
            if windows.sums[k] == 0.0 {
                continue;
            }
            let mut left = 0.25 * share * windows.weakest_with(k).max(noise);
            // Each level may have as many scatterers as one that is looked at stands for, and none of them is.
            let (sum, number) = self.unweighted[k];
            let mut unseen = (self.strides[k] - 1) as f64 * sum / number * lowest;
            let mut first_culled = LEVELS;
            while first_culled > 0 && energies[first_culled - 1] + unseen <= left {
                left -= energies[first_culled - 1] + unseen;
                unseen *= per_step;
                first_culled -= 1;
            }
            let level = libm::exp10(-STEP_DB / 20.0 * first_culled as f64) as f32;
            floors[k] = floors[k].min(level);
        }
    }
}

/// Range by which the floor of a scatterer counts, metres: half the way to its transmit point and back from its receive point, both from the transmitter.
pub(crate) fn half_path_m(scatterers: &Scatterers, i: usize, transmit_m: DVec3) -> f64 {
    let out_m = scatterers.transmit_m(i).distance(transmit_m);
    match scatterers.transmit.is_empty() {
        true => out_m,
        false => 0.5 * (out_m + scatterers.position_m(i).distance(transmit_m)),
    }
}

/// How a ping is looked at.
struct Look {
    /// Bins per metre of slant range.
    per_m: f64,
    /// Scatterers that are looked at, about.
    among: usize,
    worst_ratio: f64,
}

impl Look {
    fn new(spec: &SonarSpec, plan: &PingPlan, scatterers: &Scatterers) -> Self {
        let rate_hz = spec.receiver.sample_rate_hz;
        let c = plan.sound_speed_m_per_s;
        let window_s = plan.pulse.duration_s.max(MIN_WINDOW / rate_hz);
        let farthest_m = 0.5 * c * plan.window_s(rate_hz);
        let bin_m = (0.25 * c * window_s).max(farthest_m / (BINS - 1) as f64);
        let elements: usize = spec.receive.iter().map(|array| array.elements).sum();
        let windows = (plan.window_s(rate_hz) / window_s).ceil().max(2.0);
        let samples = 1.0 + plan.pulse.bandwidth_hz * window_s;
        let among = scatterers.len() * elements / PAIRS_PER_SAMPLE;
        Self {
            per_m: 1.0 / bin_m,
            among: among.clamp(SAMPLES.0, SAMPLES.1),
            worst_ratio: fades::worst_ratio((windows * elements as f64).ln(), samples),
        }
    }
}

/// Energies of the bins of a ping, and of the windows that begin with them.
struct Windows {
    sums: [f64; BINS],
}

impl Windows {
    /// Of the levels from `first` on.
    fn of(energies: &Energies, first: usize) -> Self {
        Self {
            sums: std::array::from_fn(|k| energies[k][first..].iter().sum()),
        }
    }

    fn sum(&self, k: usize) -> f64 {
        self.sums.get(k).copied().unwrap_or(0.0)
    }

    /// Energy of the window that begins with bin `k`.
    fn from(&self, k: usize) -> f64 {
        let before = k.checked_sub(1).map_or(0.0, |k| self.sum(k));
        before + 2.0 * self.sum(k) + self.sum(k + 1)
    }

    /// Energy of the weakest window with echoes of bin `k`.
    fn weakest_with(&self, k: usize) -> f64 {
        let before = k.checked_sub(1).map_or(self.sum(0), |k| self.from(k));
        before.min(self.from(k)).min(self.from(k + 1))
    }

    /// Noise floor of the error contract.
    fn noise(&self) -> f64 {
        let strongest = (0..BINS).map(|k| self.from(k)).fold(0.0, f64::max);
        strongest * libm::exp10(-0.1 * FLOOR_BELOW_STRONGEST_DB)
    }
}
