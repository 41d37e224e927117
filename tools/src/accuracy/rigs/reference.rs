//! Reference solutions of pings: the direct sum on the exact trajectory with second-order Doppler. The sum is sampled before the
//! receiver filter as densely as the reference. If needed, the equation of the reference is evaluated sample by sample.

use num_complex::Complex64;

use echotank_config::spec::{MediumSpec, SonarSpec};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::pulse::FLOOR_BELOW_STRONGEST_DB;
use echotank_core::scene::Scatterers;
use echotank_ping::pipeline::PipelineError;
use echotank_synthesis::array::{Decimator, Direct, fill_gains, receive};
use echotank_synthesis::echo::walk::{TransmitLeg, Window, Workspace, arrivals, insonify};

use crate::draw::SplitMix as Chance;
use crate::reference::{Probe, received, reference_filter, reference_plan, values, window_samples};

/// Number of randomly chosen samples per ping.
const LOOKED_AT: usize = 128;
/// Number of worst windows that are computed again by the reference.
const WORST: usize = 4;
/// Number of evenly spaced samples of each of these windows.
const OF_EACH: usize = 256;
/// Number of windows that begin within a window's length.
const OFFSETS: usize = 8;

pub(crate) struct Ping<'a> {
    pub(crate) spec: &'a SonarSpec,
    pub(crate) medium: &'a MediumSpec,
    pub(crate) plan: &'a PingPlan,
    /// Scatterers without culling.
    pub(crate) everything: &'a Scatterers,
}

/// Index of a sample of an element.
#[derive(Clone, Copy)]
struct Pick {
    array: usize,
    element: usize,
    sample: usize,
}

/// Window of an element, with its error.
struct WindowError {
    square: f64,
    array: usize,
    element: usize,
    first: usize,
    /// Energy that the error refers to: that of the window or the floor, whichever is higher.
    against: f64,
}

pub(crate) struct ReferenceSolution<'a> {
    ping: &'a Ping<'a>,
    plan: PingPlan,
    decimator: Option<Decimator>,
    /// Samples by array and element.
    records: Vec<Vec<Vec<Complex64>>>,
    window: usize,
    /// Energy of a window of the noise floor.
    floor: f64,
}

impl<'a> ReferenceSolution<'a> {
    pub(crate) fn new(ping: &'a Ping<'a>) -> Result<Self, PipelineError> {
        let spec = ping.spec;
        let plan = reference_plan(ping.plan);
        let window = window_samples(plan.pulse.duration_s, spec.receiver.sample_rate_hz);
        let decimator = reference_filter(spec, ping.medium)?;
        let mut reference = Self {
            ping,
            plan,
            decimator,
            records: Vec::new(),
            window,
            floor: 0.0,
        };
        reference.records = reference.sum();
        let records = reference.records.iter().enumerate();
        let elements = records.flat_map(|(array, of)| (0..of.len()).map(move |e| (array, e)));
        let loudest = elements
            .flat_map(|(array, element)| reference.energies(array, element, |_| 0.0))
            .fold(0.0, |loudest: f64, (_, level)| loudest.max(level));
        reference.floor = loudest * 10f64.powf(-FLOOR_BELOW_STRONGEST_DB / 10.0);
        Ok(reference)
    }

    fn sum(&self) -> Vec<Vec<Vec<Complex64>>> {
        let (plan, spec) = (&self.plan, self.ping.spec);
        let filter = self.decimator.as_ref();
        let of_window = (spec.receiver.sample_rate_hz, plan.first_sample_s);
        let (mut transmit_leg, mut walk) = (TransmitLeg::default(), Workspace::default());
        let mut gains = Vec::new();
        fill_gains(plan, &spec.receiver, plan.sample_count, &mut gains);
        let mut record = |index: usize, array: &ArrayGeometry, element: usize| {
            let mut record = vec![Complex64::ZERO; plan.sample_count];
            received(
                filter,
                of_window,
                &mut record,
                |ends, rate_hz, first_s, out| {
                    if element == 0 {
                        let tx = &spec.transmit[array.transmit];
                        let heard = Window::of_samples(first_s, rate_hz, out.len());
                        insonify(plan, tx, heard, self.ping.everything, &mut transmit_leg);
                    }
                    let mut sink = Direct::new(plan, rate_hz, first_s, out).with_ends(ends);
                    arrivals(plan, array, element, &transmit_leg, &mut walk, &mut sink);
                },
            );
            let receiver = &spec.receiver;
            receive(plan, receiver, &gains, array, index, element, &mut record);
            record
        };
        let arrays = spec.receive.iter().enumerate();
        arrays
            .map(|(k, array)| (0..array.elements).map(|e| record(k, array, e)).collect())
            .collect()
    }

    pub(crate) fn is_silent(&self) -> bool {
        let mut samples = self.records.iter().flatten().flatten();
        samples.all(|x| x.norm_sqr() == 0.0)
    }

    /// Values of these samples by the equation of the reference.
    fn by_reference(&self, picks: &[Pick]) -> Vec<Complex64> {
        let (plan, spec) = (&self.plan, self.ping.spec);
        let probe = |pick: &Pick| {
            let array = &spec.receive[pick.array];
            Probe {
                transmit: &spec.transmit[array.transmit],
                array,
                element: pick.element,
                sample: pick.sample,
            }
        };
        let probes: Vec<Probe> = picks.iter().map(probe).collect();
        let (filter, rate_hz) = (self.decimator.as_ref(), spec.receiver.sample_rate_hz);
        let mut values = values(plan, self.ping.everything, filter, rate_hz, &probes);
        let (receiver, mut gains) = (&spec.receiver, Vec::new());
        fill_gains(plan, receiver, 1, &mut gains);
        for (pick, value) in picks.iter().zip(&mut values) {
            let array = &spec.receive[pick.array];
            let (index, value) = (pick.array, std::slice::from_mut(value));
            receive(plan, receiver, &gains, array, index, pick.element, value);
        }
        values
    }

    /// Energies of every window of an element, by its first sample: of `off` and of the element's own samples.
    fn energies(
        &self,
        array: usize,
        element: usize,
        off: impl Fn(usize) -> f64,
    ) -> Vec<(f64, f64)> {
        let record = &self.records[array][element];
        let window = self.window.min(record.len());
        // Summed anew at every window: differences of running sums would lose the weak windows behind the strong ones.
        let sum = |first: usize| {
            let of = first..first + window;
            of.fold((0.0, 0.0), |(off_sum, level), k| {
                (off_sum + off(k), level + record[k].norm_sqr())
            })
        };
        (0..=record.len() - window)
            .step_by((window / OFFSETS).max(1))
            .map(sum)
            .collect()
    }

    /// Worst windows of every element, worst first: at most one in each stretch of a window's length.
    fn offs(&self, got: &PingOutput) -> Vec<WindowError> {
        let mut offs = Vec::new();
        for (array, (frame, records)) in got.elements.iter().zip(&self.records).enumerate() {
            for (element, want) in records.iter().enumerate() {
                let got = frame.element(element);
                let all = self.energies(array, element, |k| (got[k] - want[k]).norm_sqr());
                let mut stretches = Vec::new();
                for (k, (off, level)) in all.into_iter().enumerate() {
                    let against = level.max(self.floor);
                    let error = WindowError {
                        square: off / against,
                        array,
                        element,
                        first: k * (self.window / OFFSETS).max(1),
                        against,
                    };
                    let stretch = error.first / self.window;
                    if stretch == stretches.len() {
                        stretches.push(error);
                    } else if error.square > stretches[stretch].square {
                        stretches[stretch] = error;
                    }
                }
                offs.append(&mut stretches);
            }
        }
        // Among equal errors, the window with the higher level is first.
        let louder = |a: &WindowError, b: &WindowError| b.against.total_cmp(&a.against);
        offs.sort_by(|a, b| b.square.total_cmp(&a.square).then(louder(a, b)));
        offs
    }

    /// Error of the worst window of any element, by this reference solution.
    pub(crate) fn worst(&self, got: &PingOutput) -> f64 {
        self.offs(got).first().map_or(0.0, |off| off.square.sqrt())
    }

    /// As [`Self::worst`], by the equation of the reference, for the worst windows found here and for random samples.
    pub(crate) fn worst_by_reference(&self, got: &PingOutput) -> f64 {
        let mut worst = self.error_check(got);
        for off in self.offs(got).iter().take(WORST) {
            let end = (off.first + self.window).min(self.plan.sample_count);
            let stride = (end - off.first).div_ceil(OF_EACH);
            let picks: Vec<Pick> = (off.first..end)
                .step_by(stride)
                .map(|sample| Pick {
                    array: off.array,
                    element: off.element,
                    sample,
                })
                .collect();
            let record = got.elements[off.array].element(off.element);
            let want = self.by_reference(&picks);
            let squares = picks.iter().zip(&want);
            let sum: f64 = squares
                .map(|(pick, want)| (record[pick.sample] - want).norm_sqr())
                .sum();
            let mean = sum / picks.len() as f64;
            worst = worst.max((mean * (end - off.first) as f64 / off.against).sqrt());
        }
        worst
    }

    /// Rms error at random samples of the values that `of` returns, by the equation of the reference.
    fn by_chance(&self, of: impl Fn(&Pick) -> Complex64) -> f64 {
        let mut chance = Chance::new(u64::from(self.plan.ping_number));
        let arrays = &self.ping.spec.receive;
        let picks: Vec<Pick> = (0..LOOKED_AT)
            .map(|_| {
                let array = chance.of(arrays.len());
                Pick {
                    array,
                    element: chance.of(arrays[array].elements),
                    sample: chance.of(self.plan.sample_count),
                }
            })
            .collect();
        let want = self.by_reference(&picks);
        let squares = picks.iter().zip(&want).map(|(pick, want)| {
            let first = pick.sample.saturating_sub(self.window / 2);
            let length = self.window.min(self.plan.sample_count - first);
            let record = &self.records[pick.array][pick.element][first..first + length];
            let level: f64 = record.iter().map(|x| x.norm_sqr()).sum();
            let against = level.max(self.floor * length as f64 / self.window as f64);
            (of(pick) - want).norm_sqr() * length as f64 / against
        });
        (squares.sum::<f64>() / LOOKED_AT as f64).sqrt()
    }

    /// Error of this reference solution itself.
    pub(crate) fn own_error(&self) -> f64 {
        self.by_chance(|pick| self.records[pick.array][pick.element][pick.sample])
    }

    /// Error of a ping at the same samples.
    pub(crate) fn error_check(&self, got: &PingOutput) -> f64 {
        self.by_chance(|pick| got.elements[pick.array].element(pick.element)[pick.sample])
    }
}
