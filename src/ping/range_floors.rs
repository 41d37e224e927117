//! Pattern floors by range: what culling may leave out, window by window.
//!
//! In: a sonar without a configured culling level, a ping's plan and its scatterers. Out: [`RangeFloors`].
//!
//! Echoes from directions below a floor of the two-way pattern are left out. Where the main lobe meets the ground, the floor can be high. Windows in which
//! only side lobes do (before the main lobe reaches the ground, or where the ground rises beside the swath) are weaker and need a lower one. Each range
//! therefore has the highest floor with which culling leaves out [`LEFT_OUT`] of the tolerance at most in every window of a pulse length, relative to
//! the window or to a noise floor 55 dB below the strongest window.
//!
//! Bins are found and samples evaluated in parallel. Energies are summed in the order of the scatterers, so the floors are the same bits for any number
//! of threads.
//!
//! The energies of windows are estimated from a sample of the scatterers, by range and by level of the two-way pattern. An echo fills the window that
//! begins with it and the one that ends with it. Bins are half a window long, so the window from bin k on has E(k-1) + 2 E(k) + E(k+1), and each
//! bin may leave out a quarter of what the weakest of its three windows bears. Of a pulse shorter than half a window, a window may hold a single whole
//! bin and dark parts of others: there each bin bears a quarter of what the weakest bin around it does.
//!
//! Not every scatterer is looked at, and only for the middle element at the transmission. Any level may therefore have a scatterer that is not seen, as
//! strong as the others around it, also where a shadow's edge divides a bin.
//!
//! Echoes have random phases, so the energies fluctuate: the part left out may be strong where the whole is weak. For Gaussian samples the part left out is
//! s of the whole (its share of the energy), and a rest that does not depend on the whole, of mean energy s (1 - s). Its error is at most
//! s + sqrt(s (1 - s) R) in all but the rarest windows, with the ratio R of [`fades::worst_ratio`].
//!
//! Levels are coarse and the weakest of three windows binds, so most windows lose less. [`RangeFloors::left_out`] has the largest error of any
//! window, of its own energy and what its own bins leave out.

use std::ops::Range;

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use echotank_config::spec::SonarSpec;
use echotank_core::ping::{PingPlan, RangeFloors};
use echotank_core::pulse::{MIN_WINDOW, noise_share};
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_core::simd::widest;
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

/// Bins to either side whose scatterers tell how strong one that is not looked at may be.
const AROUND: usize = 4;

/// Scatterers whose bins one task finds.
const CHUNK: usize = 8192;
/// Samples that one task evaluates, and those that are evaluated together.
const SAMPLES_TOGETHER: usize = 256;
const LANES: usize = 16;
/// Bin of scatterers beyond the last one.
const BEYOND: u16 = BINS as u16;
/// Added to the bin of scatterers that are all looked at.
const ALWAYS: u16 = 1 << 15;

/// Energies of one array, by range and level.
type Energies = [[f64; LEVELS]; BINS];

/// Room for the floors of a ping.
pub(crate) fn with_room() -> RangeFloors {
    RangeFloors {
        per_m: 0.0,
        levels: Vec::with_capacity(BINS),
        left_out: 0.0,
    }
}

/// Finds the floors of pings. Keeps its tables, so that no ping allocates.
pub struct RangeFloorFinder {
    energies: Box<Energies>,
    choice: Choice,
    /// Of the scatterers that are looked at.
    samples: Vec<Sample>,
    /// By bin: energies of the scatterers that are looked at, each over the square of its level, and how many there are.
    unweighted: [(f64, f64); BINS],
    /// By bin: energy below its level.
    culled: [f64; BINS],
}

impl Default for RangeFloorFinder {
    fn default() -> Self {
        Self {
            energies: vec![[0.0; LEVELS]; BINS]
                .into_boxed_slice()
                .try_into()
                .unwrap_or_else(|_| Box::new([[0.0; LEVELS]; BINS])),
            choice: Choice::default(),
            samples: Vec::new(),
            unweighted: [(0.0, 0.0); BINS],
            culled: [0.0; BINS],
        }
    }
}

impl RangeFloorFinder {
    /// Sets the floors of `plan`; none where the floor of the model is configured, or absent.
    pub fn find(&mut self, spec: &SonarSpec, plan: &mut PingPlan, scatterers: &Scatterers) {
        let mut floors = std::mem::take(&mut plan.range_floors);
        floors.levels.clear();
        floors.left_out = 0.0;
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
        self.choice.from_m = None;
        floors.levels.resize(BINS, f32::INFINITY);
        let allowed = LEFT_OUT / MARGIN * spec.synthesis.tolerance;
        let share = allowed * allowed / look.worst_ratio;
        for array in 0..spec.receive.len() {
            self.add_up(spec, plan, scatterers, array, &look);
            let left_out = self.lower(share, &look, &mut floors.levels);
            floors.left_out = floors.left_out.max(left_out);
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
        self.choice.from_m = None;
        for array in 0..spec.receive.len() {
            self.add_up(spec, plan, scatterers, array, &look);
            let all = Windows::of(&self.energies, 0, look.short_pulse);
            let left_out = Windows::of(&self.energies, first_culled, look.short_pulse);
            worst = worst.max(all.largest_error(&left_out, look.worst_ratio));
        }
        worst
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
        let ear = Ear::new(spec, plan, array);
        self.choice.choose(scatterers, ear.transmit_m, look);
        let choice = &self.choice;
        let chosen = &choice.chosen[..];
        reserve(&mut self.samples, chosen.len());
        self.samples.resize(chosen.len(), Sample::default());
        self.samples
            .par_chunks_mut(SAMPLES_TOGETHER)
            .zip(chosen.par_chunks(SAMPLES_TOGETHER))
            .for_each(|(samples, chosen)| ear.look_at(scatterers, chosen, samples));
        self.energies.fill([0.0; LEVELS]);
        self.unweighted.fill((0.0, 0.0));
        for (sample, i) in self.samples.iter().zip(chosen) {
            if sample.energy > 0.0 {
                let code = choice.bins[*i as usize];
                let bin = usize::from(code & !ALWAYS);
                let weight = match code & ALWAYS {
                    0 => f64::from(choice.strides[bin]),
                    _ => 1.0,
                };
                self.energies[bin][sample.step] += weight * sample.energy;
                let (sum, number) = &mut self.unweighted[bin];
                *sum += sample.unweighted;
                *number += 1.0;
            }
        }
    }

    /// Lowers `floors` to what the array needs: at most `share` of the energy of any window is left out. The largest error of a window.
    fn lower(&mut self, share: f64, look: &Look, floors: &mut [f32]) -> f64 {
        self.culled = [0.0; BINS];
        let windows = Windows::of(&self.energies, 0, look.short_pulse);
        let noise = windows.noise();
        let per_step = libm::exp10(0.1 * STEP_DB);
        let lowest = per_step.powi(1 - LEVELS as i32);
        for (k, energies) in self.energies.iter().enumerate() {
            if windows.sums[k] == 0.0 {
                continue;
            }
            let bears = 0.25 * share * windows.weakest_with(k).max(noise);
            let mut left = bears;
            // Each level may have as many scatterers as one that is looked at stands for, and none of them is; or one that only another element or a
            // later instant hears.
            let unseen = (self.choice.strides[k] - 1).max(1);
            let mut unseen = f64::from(unseen) * self.strength(k) * lowest;
            let mut first_culled = LEVELS;
            while first_culled > 0 && energies[first_culled - 1] + unseen <= left {
                left -= energies[first_culled - 1] + unseen;
                unseen *= per_step;
                first_culled -= 1;
            }
            let level = libm::exp10(-STEP_DB / 20.0 * first_culled as f64) as f32;
            floors[k] = floors[k].min(level);
            self.culled[k] = bears - left;
        }
        let culled = Windows {
            sums: self.culled,
            ..windows
        };
        windows.largest_error(&culled, look.worst_ratio)
    }

    /// Mean energy, over the square of its level, of a scatterer of a bin that was looked at, or of those around it, whichever is larger.
    fn strength(&self, k: usize) -> f64 {
        let mean = |bins: &[(f64, f64)]| {
            let (sum, number) = bins
                .iter()
                .fold((0.0, 0.0), |(a, b), (sum, number)| (a + sum, b + number));
            sum / number
        };
        let around = k.saturating_sub(AROUND)..(k + AROUND + 1).min(BINS);
        mean(&self.unweighted[k..=k]).max(mean(&self.unweighted[around]))
    }
}

/// Which scatterers are looked at.
struct Choice {
    /// Transmitter from which the lists below count; none before the first array of a ping.
    from_m: Option<DVec3>,
    /// Bin of each scatterer, at most [`BEYOND`], with [`ALWAYS`].
    bins: Vec<u16>,
    chunks: Vec<ChunkCounts>,
    /// By bin: how many scatterers of the ground one that is looked at stands for.
    strides: [u32; BINS],
    /// Indices of the scatterers that are looked at, ascending.
    chosen: Vec<u32>,
}

impl Default for Choice {
    fn default() -> Self {
        Self {
            from_m: None,
            bins: Vec::new(),
            chunks: Vec::new(),
            strides: [1; BINS],
            chosen: Vec::new(),
        }
    }
}

/// Scatterers of a chunk.
#[derive(Clone)]
struct ChunkCounts {
    /// Those of the ground by bin; later, those of the chunks before.
    ground: [u32; BINS],
    /// Those that are all looked at, by bin.
    always: [u32; BINS],
    chosen: usize,
}

impl ChunkCounts {
    const NOTHING: Self = Self {
        ground: [0; BINS],
        always: [0; BINS],
        chosen: 0,
    };
}

impl Choice {
    fn choose(&mut self, scatterers: &Scatterers, transmit_m: DVec3, look: &Look) {
        if self.from_m.replace(transmit_m) == Some(transmit_m) {
            return;
        }
        let len = scatterers.len();
        reserve(&mut self.bins, len);
        self.bins.resize(len, BEYOND);
        reserve(&mut self.chunks, len.div_ceil(CHUNK));
        self.chunks
            .resize(len.div_ceil(CHUNK), ChunkCounts::NOTHING);
        self.bins
            .par_chunks_mut(CHUNK)
            .zip(&mut self.chunks)
            .enumerate()
            .for_each(|(chunk, (bins, counts))| {
                let span = chunk * CHUNK..chunk * CHUNK + bins.len();
                widest(
                    #[inline(always)]
                    || find_bins(scatterers, span, transmit_m, look.per_m, bins),
                );
                counts.count(bins);
            });
        let mut all = [0; BINS];
        for chunk in &self.chunks {
            for (all, (ground, always)) in
                all.iter_mut().zip(chunk.ground.iter().zip(&chunk.always))
            {
                *all += ground + always;
            }
        }
        let used = all.iter().filter(|count| **count > 0).count();
        let of_bin = (look.among / used.max(1)).max(SAMPLES_PER_BIN) as u32;
        for (stride, count) in self.strides.iter_mut().zip(all) {
            *stride = count.div_ceil(of_bin).max(1);
        }
        let mut before = [0; BINS];
        let mut chosen = 0;
        for chunk in &mut self.chunks {
            chunk.place(&mut before, &self.strides);
            chosen += chunk.chosen;
        }
        reserve(&mut self.chosen, chosen);
        self.chosen.resize(chosen, 0);
        choose_of(&self.chunks, &self.bins, &self.strides, 0, &mut self.chosen);
    }
}

impl ChunkCounts {
    fn count(&mut self, bins: &[u16]) {
        *self = Self::NOTHING;
        for code in bins {
            let (bin, counts) = match code & ALWAYS {
                0 => (usize::from(*code), &mut self.ground),
                _ => (usize::from(code & !ALWAYS), &mut self.always),
            };
            if let Some(count) = counts.get_mut(bin) {
                *count += 1;
            }
        }
    }

    /// Replaces the numbers of scatterers of the ground by those `before`, adds to these, and counts the scatterers that are chosen.
    fn place(&mut self, before: &mut [u32; BINS], strides: &[u32; BINS]) {
        self.chosen = 0;
        for (bin, before) in before.iter_mut().enumerate() {
            let first = *before;
            *before += std::mem::replace(&mut self.ground[bin], first);
            let of_ground = before.div_ceil(strides[bin]) - first.div_ceil(strides[bin]);
            self.chosen += (of_ground + self.always[bin]) as usize;
        }
    }

    /// Lists the scatterers of the chunk that are looked at. `first` is the index of its first one.
    fn choose(&self, bins: &[u16], strides: &[u32; BINS], first: usize, chosen: &mut [u32]) {
        // Scatterers of the ground up to the next one that is looked at.
        let mut left: [u32; BINS] = std::array::from_fn(|bin| {
            let of_stride = self.ground[bin] % strides[bin];
            if of_stride == 0 {
                0
            } else {
                strides[bin] - of_stride
            }
        });
        let mut places = chosen.iter_mut();
        for (i, code) in (first as u32..).zip(bins) {
            let bin = usize::from(code & !ALWAYS);
            let Some(left) = left.get_mut(bin) else {
                continue;
            };
            if code & ALWAYS == 0 {
                if *left > 0 {
                    *left -= 1;
                    continue;
                }
                *left = strides[bin] - 1;
            }
            if let Some(place) = places.next() {
                *place = i;
            }
        }
    }
}

/// Lists the scatterers of all chunks that are looked at. `first` is the index of the first scatterer.
fn choose_of(
    chunks: &[ChunkCounts],
    bins: &[u16],
    strides: &[u32; BINS],
    first: usize,
    chosen: &mut [u32],
) {
    match chunks {
        [] => {}
        [chunk] => chunk.choose(bins, strides, first, chosen),
        _ => {
            let (a, b) = chunks.split_at(chunks.len() / 2);
            let middle = a.len() * CHUNK;
            let (bins_a, bins_b) = bins.split_at(middle);
            let (chosen_a, chosen_b) = chosen.split_at_mut(a.iter().map(|c| c.chosen).sum());
            rayon::join(
                || choose_of(a, bins_a, strides, first, chosen_a),
                || choose_of(b, bins_b, strides, first + middle, chosen_b),
            );
        }
    }
}

/// Bins of a span of scatterers. A loop without branches.
#[inline(always)]
fn find_bins(
    scatterers: &Scatterers,
    span: Range<usize>,
    transmit_m: DVec3,
    per_m: f64,
    bins: &mut [u16],
) {
    let back = Distances::new(
        [&scatterers.north_m, &scatterers.east_m, &scatterers.down_m],
        &span,
        transmit_m,
    );
    let loud = &scatterers.loud[span.clone()];
    let of = |range_m: f64, loud: f32| {
        let bin = (range_m * per_m).min(f64::from(BEYOND)) as i32 as u16;
        // Targets and points that are stronger than the ground.
        bin | if loud <= 1.0 { 0 } else { ALWAYS }
    };
    if scatterers.transmit.is_empty() {
        for (i, (bin, loud)) in bins.iter_mut().zip(loud).enumerate() {
            *bin = of(back.at_m(i), *loud);
        }
    } else {
        let transmit = &scatterers.transmit;
        let out = Distances::new(
            [&transmit.north_m, &transmit.east_m, &transmit.down_m],
            &span,
            transmit_m,
        );
        for (i, (bin, loud)) in bins.iter_mut().zip(loud).enumerate() {
            *bin = of(0.5 * (out.at_m(i) + back.at_m(i)), *loud);
        }
    }
}

/// Distances of points from another point.
struct Distances<'a> {
    points_m: [&'a [f64]; 3],
    from_m: DVec3,
}

impl<'a> Distances<'a> {
    #[inline(always)]
    fn new(points_m: [&'a [f64]; 3], span: &Range<usize>, from_m: DVec3) -> Self {
        Self {
            points_m: points_m.map(|m| &m[span.clone()]),
            from_m,
        }
    }

    #[inline(always)]
    fn at_m(&self, i: usize) -> f64 {
        let [north_m, east_m, down_m] = self.points_m;
        let (x, y, z) = (
            north_m[i] - self.from_m.x,
            east_m[i] - self.from_m.y,
            down_m[i] - self.from_m.z,
        );
        (x * x + y * y + z * z).sqrt()
    }
}

/// Reserves room for `len` values and some more, so that slightly larger pings do not allocate.
fn reserve<T>(list: &mut Vec<T>, len: usize) {
    if list.capacity() < len {
        list.reserve(len + len / 4 - list.len());
    }
}

/// A scatterer that is looked at.
#[derive(Clone, Copy, Debug, Default)]
struct Sample {
    /// 0 where no echo is received.
    energy: f64,
    /// Energy over the square of the level.
    unweighted: f64,
    /// Step of the two-way level.
    step: usize,
}

/// The middle element of an array, and its transmitter.
struct Ear {
    sent: Directivity,
    received: Directivity,
    one_way: OneWay,
    transmit_from_world: DMat3,
    array_from_world: DMat3,
    transmit_m: DVec3,
    receive_m: DVec3,
}

impl Ear {
    fn new(spec: &SonarSpec, plan: &PingPlan, array: usize) -> Self {
        let array = &spec.receive[array];
        let transmit = &spec.transmit[array.transmit];
        let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
        let pose = plan.trajectory.pose_at(0.0);
        let from_world = |of: DQuat| DMat3::from_quat((pose.world_from_body * of).inverse());
        Self {
            sent: Directivity::new(&transmit.pattern, wavelength_m),
            received: Directivity::new(&array.envelope_pattern(), wavelength_m),
            one_way: OneWay::new(wavelength_m, plan.absorption_db_per_m),
            transmit_from_world: from_world(transmit.mounting.body_from_array),
            array_from_world: from_world(array.mounting.body_from_array),
            transmit_m: pose.point_m(transmit.mounting.position_m),
            receive_m: pose.point_m(array.element_body_m(array.elements / 2)),
        }
    }

    /// Evaluates scatterers, [`LANES`] together.
    fn look_at(&self, scatterers: &Scatterers, chosen: &[u32], samples: &mut [Sample]) {
        for (chosen, samples) in chosen.chunks(LANES).zip(samples.chunks_mut(LANES)) {
            let seen = Seen::new(scatterers, chosen);
            let rays = widest(
                #[inline(always)]
                || self.rays(&seen),
            );
            for (lane, (sample, i)) in samples.iter_mut().zip(chosen).enumerate() {
                *sample = rays.sample(lane, scatterers, *i as usize);
            }
        }
    }

    /// A loop without branches.
    #[inline(always)]
    fn rays(&self, seen: &Seen) -> Rays {
        let mut rays = Rays::default();
        let array = |turn: &DMat3| turn.transpose().to_cols_array_2d();
        let (sent, received) = (
            array(&self.transmit_from_world),
            array(&self.array_from_world),
        );
        for i in 0..LANES {
            let (out, out_range_m) = unit(&seen.transmit_m, i, self.transmit_m);
            let (back, back_range_m) = unit(&seen.position_m, i, self.receive_m);
            let towards = |pattern: &Directivity, rows: &[[f64; 3]; 3], ray: [f64; 3]| {
                let [x, y, z] = rows.map(
                    #[inline(always)]
                    |row| dot(row, ray),
                );
                pattern.towards(x, y, z)
            };
            let facing = |normal: &[[f64; LANES]; 3], ray: [f64; 3]| {
                let inward = [-normal[0][i], -normal[1][i], -normal[2][i]];
                dot(inward, ray).clamp(0.0, 1.0)
            };
            rays.level[i] =
                towards(&self.sent, &sent, out) * towards(&self.received, &received, back);
            rays.facing_out[i] = facing(&seen.transmit_normal, out);
            rays.facing_back[i] = facing(&seen.normal, back);
            rays.loss[i] =
                self.one_way.amplitude(out_range_m) * self.one_way.amplitude(back_range_m);
        }
        rays
    }
}

#[inline(always)]
fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Direction of a point from another, not a number where they are the same, and their distance.
#[inline(always)]
fn unit(points_m: &[[f64; LANES]; 3], i: usize, from_m: DVec3) -> ([f64; 3], f64) {
    let [x, y, z] = [
        points_m[0][i] - from_m.x,
        points_m[1][i] - from_m.y,
        points_m[2][i] - from_m.z,
    ];
    let range_m = dot([x, y, z], [x, y, z]).sqrt();
    ([x / range_m, y / range_m, z / range_m], range_m)
}

/// Places and normals of scatterers that are evaluated together, as both legs see them.
struct Seen {
    transmit_m: [[f64; LANES]; 3],
    position_m: [[f64; LANES]; 3],
    transmit_normal: [[f64; LANES]; 3],
    normal: [[f64; LANES]; 3],
}

impl Seen {
    fn new(scatterers: &Scatterers, chosen: &[u32]) -> Self {
        let nothing = [[0.0; LANES]; 3];
        let mut seen = Self {
            transmit_m: nothing,
            position_m: nothing,
            transmit_normal: nothing,
            normal: nothing,
        };
        for (lane, i) in chosen.iter().enumerate() {
            let i = *i as usize;
            let mut set = |list: fn(&mut Self) -> &mut [[f64; LANES]; 3], value: [f64; 3]| {
                for (list, value) in list(&mut seen).iter_mut().zip(value) {
                    list[lane] = value;
                }
            };
            set(|s| &mut s.transmit_m, scatterers.transmit_m(i).to_array());
            set(|s| &mut s.position_m, scatterers.position_m(i).to_array());
            set(
                |s| &mut s.transmit_normal,
                scatterers.transmit_normal(i).map(f64::from),
            );
            set(|s| &mut s.normal, scatterers.normal[i].map(f64::from));
        }
        seen
    }
}

/// Both legs of scatterers that are evaluated together.
#[derive(Default)]
struct Rays {
    /// Two-way pattern.
    level: [f64; LANES],
    /// Cosines between the normal and the rays.
    facing_out: [f64; LANES],
    facing_back: [f64; LANES],
    /// Two-way loss.
    loss: [f64; LANES],
}

impl Rays {
    fn sample(&self, lane: usize, scatterers: &Scatterers, i: usize) -> Sample {
        let (facing_out, facing_back) = (self.facing_out[lane], self.facing_back[lane]);
        let law = match scatterers.law[i] {
            ScatterLaw::Point | ScatterLaw::Water => 1.0,
            ScatterLaw::Lambert => (facing_out * facing_back).sqrt(),
            ScatterLaw::LambertOneWay => facing_out,
            ScatterLaw::Curve => scatterers.curve.as_deref().map_or(0.0, |curve| {
                curve.half(facing_out.sqrt()) * curve.half(facing_back.sqrt())
            }),
        };
        let level = self.level[lane];
        let energy = (level * law * self.loss[lane]).powi(2) * scatterers.strength[i].norm_sqr();
        // Not where a leg has no direction.
        if energy > 0.0 {
            let tested = level.abs() * f64::from(scatterers.loud[i]);
            let step = (-20.0 / STEP_DB * libm::log10(tested)).max(0.0) as usize;
            Sample {
                energy,
                unweighted: energy / (tested * tested),
                step: step.min(LEVELS - 1),
            }
        } else {
            Sample::default()
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
    /// A pulse is at most half a window long.
    short_pulse: bool,
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
            short_pulse: plan.pulse.duration_s <= 0.5 * window_s,
        }
    }
}

/// Energies of the bins of a ping, and of the windows that begin with them.
struct Windows {
    sums: [f64; BINS],
    short_pulse: bool,
}

impl Windows {
    /// Of the levels from `first` on.
    fn of(energies: &Energies, first: usize, short_pulse: bool) -> Self {
        Self {
            sums: std::array::from_fn(|k| energies[k][first..].iter().sum()),
            short_pulse,
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

    /// Energy that the window which begins with bin `k` has at least, also if it begins a little before.
    fn least(&self, k: usize) -> f64 {
        match self.short_pulse {
            true => self.sum(k),
            false => self.from(k),
        }
    }

    /// Energy of the weakest window with echoes of bin `k`.
    fn weakest_with(&self, k: usize) -> f64 {
        let before = match (k.checked_sub(1), self.short_pulse) {
            (Some(before), _) => self.least(before),
            (None, true) => 0.0,
            (None, false) => self.sum(0),
        };
        // A short echo may end in the next bin, and the window with its end holds the one after.
        let last = k + if self.short_pulse { 2 } else { 1 };
        (k..=last).map(|k| self.least(k)).fold(before, f64::min)
    }

    /// Largest error of a window without what of its energies is `culled`.
    fn largest_error(&self, culled: &Self, worst_ratio: f64) -> f64 {
        let noise = self.noise();
        let errors = (0..BINS).map(|k| {
            let share = culled.from(k) / self.least(k).max(noise).max(f64::MIN_POSITIVE);
            let share = share.min(1.0);
            share + (share * (1.0 - share) * worst_ratio).sqrt()
        });
        MARGIN * errors.fold(0.0, f64::max)
    }

    /// Noise floor of the error contract.
    fn noise(&self) -> f64 {
        let strongest = (0..BINS).map(|k| self.least(k)).fold(0.0, f64::max);
        strongest * noise_share()
    }
}

#[cfg(test)]
mod tests {
    use echotank_core::arrays::Pattern;
    use num_complex::Complex64;

    use super::*;

    /// Scatterers up to 60 m away, in clusters as those of tiles; every hundredth is loud.
    fn scatterers(count: usize, images: bool) -> Scatterers {
        let mut scatterers = Scatterers::default();
        let share = |k: usize, step: f64| (k as f64 * step).fract();
        for k in 0..count {
            let position_m = DVec3::new(
                40.0 * share(k / 200, 0.754_877_666) + share(k, 0.569_840_291) - 20.0,
                60.0 * share(k / 200, 0.380_277_569) + share(k, 0.245_122_333),
                10.0 + share(k, 0.671_043_607),
            );
            scatterers.push(
                position_m,
                [0.0, 0.0, -1.0],
                Complex64::ONE,
                ScatterLaw::Point,
            );
            if k % 100 == 7 {
                scatterers.loud[k] = 3.0;
            }
            if images {
                scatterers.push_transmit(position_m + DVec3::Z * share(k, 0.819_172_513), [0.0; 3]);
            }
        }
        scatterers
    }

    /// Bins, strides and chosen scatterers, one scatterer after the other.
    fn serial(
        scatterers: &Scatterers,
        transmit_m: DVec3,
        look: &Look,
    ) -> ([usize; BINS], Vec<u32>) {
        let bin_of = |i: usize| (half_path_m(scatterers, i, transmit_m) * look.per_m) as usize;
        let mut counts = [0usize; BINS];
        for i in 0..scatterers.len() {
            if let Some(count) = counts.get_mut(bin_of(i)) {
                *count += 1;
            }
        }
        let used = counts.iter().filter(|count| **count > 0).count();
        let of_bin = (look.among / used.max(1)).max(SAMPLES_PER_BIN);
        let strides = counts.map(|count| count.div_ceil(of_bin).max(1));
        let mut numbers = [0; BINS];
        let looked_at = |i: &u32| {
            let (i, bin) = (*i as usize, bin_of(*i as usize));
            if bin >= BINS {
                return false;
            }
            if scatterers.loud[i] > 1.0 {
                return true;
            }
            numbers[bin] += 1;
            (numbers[bin] - 1usize).is_multiple_of(strides[bin])
        };
        (
            strides,
            (0..scatterers.len() as u32).filter(looked_at).collect(),
        )
    }

    #[test]
    fn scatterers_are_chosen_in_parallel_as_one_after_the_other() {
        // Whole chunks, parts of them and less than one; the last choice needs less room than those before.
        for (count, images) in [
            (100_000, false),
            (5 * CHUNK, true),
            (20_000, true),
            (777, false),
        ] {
            let scatterers = scatterers(count, images);
            let look = Look {
                per_m: 5.0,
                among: 3000,
                worst_ratio: 1.0,
                short_pulse: false,
            };
            let mut choice = Choice::default();
            for transmit_m in [DVec3::ZERO, DVec3::new(1.0, -2.0, 0.5)] {
                let (strides, chosen) = serial(&scatterers, transmit_m, &look);
                for threads in [1, 2, 5] {
                    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
                    choice.from_m = None;
                    pool.expect("a pool")
                        .install(|| choice.choose(&scatterers, transmit_m, &look));
                    assert_eq!(choice.strides.map(|stride| stride as usize), strides);
                    assert!(choice.chosen == chosen, "{count} on {threads} threads");
                }
                println!("{} of {count} chosen", chosen.len());
                let beyond = choice
                    .bins
                    .iter()
                    .filter(|code| *code & !ALWAYS == BEYOND)
                    .count();
                let some = beyond > 0 && chosen.len() < count;
                assert!(some || count < CHUNK, "{beyond} of {count} beyond");
            }
        }
    }

    /// Bins with levels of random energies, and one weak bin among them: floors keep the share that they may, and what they leave out of each window
    /// is predicted, by itself.
    #[test]
    fn what_floors_leave_out_of_a_window_is_counted_against_that_window() {
        let mut finder = RangeFloorFinder::default();
        for k in 10..60 {
            let weak = if k == 30 { 1e-3 } else { 1.0 };
            for level in 0..LEVELS {
                let uneven = 1.0 + ((k * 31 + level * 17) as f64 * 0.618_033_988).fract();
                finder.energies[k][level] = weak * uneven * libm::exp10(-0.3 * level as f64);
            }
            // One more scatterer at each level would hardly be heard.
            finder.unweighted[k] = (1e-12, 1.0);
        }
        let (share, ratio) = (1e-5, 6.0);
        let look = Look {
            per_m: 5.0,
            among: 3000,
            worst_ratio: ratio,
            short_pulse: false,
        };
        let mut floors = [f32::INFINITY; BINS];
        let got = finder.lower(share, &look, &mut floors);
        let mut worst = 0.0f64;
        for k in 0..BINS - 1 {
            let of = |from: &dyn Fn(usize) -> usize| {
                let bin = |k: usize| finder.energies[k][from(k)..].iter().sum::<f64>();
                let before = k.checked_sub(1).map_or(0.0, bin);
                before + 2.0 * bin(k) + bin(k + 1)
            };
            let first_culled = |k: usize| {
                let steps = -20.0 / STEP_DB * f64::from(floors[k]).log10();
                if steps.is_finite() {
                    steps.round() as usize
                } else {
                    LEVELS
                }
            };
            let (all, culled) = (of(&|_| 0), of(&first_culled));
            if all > 0.0 {
                let s = culled / all;
                assert!(s <= share * (1.0 + 1e-6), "{k}: {s:e}");
                worst = worst.max(s + (s * (1.0 - s) * ratio).sqrt());
            }
        }
        println!("{got:.3e}, counted {:.3e}", MARGIN * worst);
        assert!(
            (got / (MARGIN * worst) - 1.0).abs() < 1e-6,
            "{got:e} {worst:e}"
        );
        // No more than they may leave out of every window.
        assert!(got < MARGIN * (share * ratio).sqrt(), "{got:e}");
    }

    /// A narrow shadow between lit bins. The scatterers in it that were looked at are faint, and those that were not may be lit: none is left out that
    /// would be heard in the dark window, also where all were looked at, but by one element only. Of a short pulse, a window of two bins may lie in the
    /// dark with one bin and parts of the lit ones around.
    #[test]
    fn nothing_lit_is_left_out_of_a_narrow_shadow() {
        const DARK: Range<usize> = 40..42;
        for (short_pulse, stride) in [(false, 20), (true, 20), (false, 1), (true, 1)] {
            let mut finder = RangeFloorFinder::default();
            for k in 10..60 {
                let strength = if DARK.contains(&k) { 1e-5 } else { 1.0 };
                for level in 0..LEVELS {
                    finder.energies[k][level] = strength * libm::exp10(-0.3 * level as f64);
                }
                finder.unweighted[k] = (16.0 * strength, 16.0);
                finder.choice.strides[k] = stride;
            }
            let look = Look {
                per_m: 5.0,
                among: 3000,
                worst_ratio: 1.0,
                short_pulse,
            };
            let share = 1e-5;
            let mut floors = [f32::INFINITY; BINS];
            finder.lower(share, &look, &mut floors);
            let windows = Windows::of(&finder.energies, 0, false);
            let (lit, dark) = (windows.sum(30), windows.sum(40));
            for (k, floor) in floors.iter().enumerate().take(50).skip(30) {
                // Of a long pulse, echoes of the lit bins reach into every window with the dark ones.
                let bears = match short_pulse {
                    true if (38..43).contains(&k) => dark,
                    _ => lit,
                };
                let unseen = f64::from((stride - 1).max(1)) / 9.0 * f64::from(*floor).powi(2) / 2.0;
                println!("{k}: {:.1} dB", 20.0 * floor.log10());
                assert!(
                    unseen <= 2.0 * share * bears,
                    "{short_pulse} {stride} {k}: {unseen:e}"
                );
            }
        }
    }

    /// One scatterer after the other, with vectors.
    fn sample(ear: &Ear, scatterers: &Scatterers, i: usize) -> (f64, usize) {
        let out_m = scatterers.transmit_m(i) - ear.transmit_m;
        let back_m = scatterers.position_m(i) - ear.receive_m;
        let (out, back) = (out_m / out_m.length(), back_m / back_m.length());
        let towards = |pattern: &Directivity, turn: &DMat3, ray: DVec3| {
            let u = *turn * ray;
            pattern.towards(u.x, u.y, u.z)
        };
        let level = towards(&ear.sent, &ear.transmit_from_world, out)
            * towards(&ear.received, &ear.array_from_world, back);
        let facing = |normal: [f32; 3], ray: DVec3| {
            (-DVec3::from(normal.map(f64::from)).dot(ray)).clamp(0.0, 1.0)
        };
        let facing_out = facing(scatterers.transmit_normal(i), out);
        let facing_back = facing(scatterers.normal[i], back);
        let law = match scatterers.law[i] {
            ScatterLaw::Lambert => (facing_out * facing_back).sqrt(),
            ScatterLaw::LambertOneWay => facing_out,
            _ => 1.0,
        };
        let loss = ear.one_way.amplitude(out_m.length()) * ear.one_way.amplitude(back_m.length());
        let energy = (level * law * loss).powi(2) * scatterers.strength[i].norm_sqr();
        if energy.is_nan() || energy <= 0.0 {
            return (0.0, 0);
        }
        let tested = level.abs() * f64::from(scatterers.loud[i]);
        let step = (-20.0 / STEP_DB * tested.log10()).max(0.0) as usize;
        (energy, step.min(LEVELS - 1))
    }

    #[test]
    fn samples_evaluated_together_are_those_evaluated_one_after_the_other() {
        let pattern = |length_m: f64, baffled| Pattern::Rectangle {
            length_m,
            width_m: 0.01,
            baffled,
        };
        let ear = Ear {
            sent: Directivity::new(&pattern(0.3, true), 0.005),
            received: Directivity::new(&pattern(0.02, false), 0.005),
            one_way: OneWay::new(0.005, 0.1),
            transmit_from_world: DMat3::from_rotation_x(-0.6) * DMat3::from_rotation_z(0.2),
            array_from_world: DMat3::from_rotation_x(-0.3) * DMat3::from_rotation_y(0.1),
            transmit_m: DVec3::new(0.1, 0.2, 0.3),
            receive_m: DVec3::new(-0.4, 0.1, 0.2),
        };
        for images in [false, true] {
            let mut scatterers = scatterers(3001, images);
            let laws = [
                ScatterLaw::Point,
                ScatterLaw::Lambert,
                ScatterLaw::LambertOneWay,
            ];
            for (i, law) in scatterers.law.iter_mut().enumerate() {
                *law = laws[i % 3];
            }
            let all: Vec<u32> = (0..3001).collect();
            let mut samples = vec![Sample::default(); all.len()];
            ear.look_at(&scatterers, &all, &mut samples);
            let mut received = 0;
            for (i, own) in samples.iter().enumerate() {
                let (energy, step) = sample(&ear, &scatterers, i);
                assert_eq!(
                    (own.energy.to_bits(), own.step),
                    (energy.to_bits(), step),
                    "{i}"
                );
                received += usize::from(energy > 0.0);
            }
            println!("{received} of {} received", all.len());
            assert!((100..3000).contains(&received), "{received}");
        }
    }
}
