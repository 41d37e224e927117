//! Time of a line array's ping by stage: core milliseconds, and the limit from the peak rates of the processor.
//!
//! Operations and bytes follow from the sizes that the tasks report. Peak rates are measured in the same run, on one core.

use std::hint::black_box;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use echotank_synthesis::array::gridded2d::{Stage, Stages, TaskReport, measure_stages};

/// Bytes of a complex grid value in f32.
const COMPLEX_BYTES: f64 = 8.0;
/// Interpolation points in the pulse tables.
const PULSE_POINTS: f64 = 8.0;

/// Stage times of the fastest run.
#[derive(Default)]
pub(crate) struct Profile {
    pub(crate) insonify: Duration,
    pub(crate) stages: Stages,
    /// Wall time of all engine calls.
    pub(crate) synthesise: Duration,
    pub(crate) reports: Vec<TaskReport>,
}

impl Profile {
    /// Empty profile. The stages of the engine are measured from now on.
    pub(crate) fn start() -> Self {
        static START: OnceLock<Instant> = OnceLock::new();
        START.get_or_init(Instant::now);
        measure_stages(|| START.get().map_or(Duration::ZERO, Instant::elapsed));
        Self::default()
    }

    pub(crate) fn keep(
        &mut self,
        insonify: Duration,
        synthesise: Duration,
        reports: Vec<TaskReport>,
    ) {
        let mut stages = Stages::default();
        for report in &reports {
            stages.add(&report.stages);
        }
        if self.reports.is_empty() || stages.total() < self.stages.total() {
            *self = Self {
                insonify,
                stages,
                synthesise,
                reports,
            };
        }
    }

    pub(crate) fn print(&self, threads: usize) {
        let roof = Roofline::measure();
        println!(
            "  one core: {:.0} GFLOP/s in f32, {:.0} GB/s from memory, {:.0} GB/s in 1 MB; {threads} threads",
            roof.flops * 1e-9,
            roof.memory * 1e-9,
            roof.cache * 1e-9
        );
        println!(
            "  {:<10} {:>9} {:>9} {:>8} {:>9} {:>9}",
            "stage", "core ms", "GFLOP", "GB", "bound ms", "of bound"
        );
        let ms = |time: Duration| 1e3 * time.as_secs_f64();
        println!("  {:<10} {:>9.2}", "insonify", ms(self.insonify));
        for stage in Stage::ALL {
            let spent = ms(self.stages.spent(stage));
            let work = self
                .reports
                .iter()
                .map(|report| Work::of(stage, report))
                .fold(Work::default(), |a, b| Work {
                    flops: a.flops + b.flops,
                    bytes: a.bytes + b.bytes,
                });
            let bound = 1e3 * (work.flops / roof.flops).max(work.bytes / roof.memory);
            let share = if bound > 0.0 {
                format!("{:>8.1} x", spent / bound)
            } else {
                String::new()
            };
            println!(
                "  {:<10} {spent:>9.2} {:>9.3} {:>8.3} {bound:>9.2} {share:>9}",
                stage.name(),
                work.flops * 1e-9,
                work.bytes * 1e-9,
            );
        }
        println!(
            "  {:<10} {:>9.2}  wall {:.2}",
            "all stages",
            ms(self.stages.total()),
            ms(self.synthesise)
        );
        for r in &self.reports {
            println!(
                "    {} elements, {} echoes: {} columns x {} rows, {} channels in {} products, {} bins, {} entries, {} powers, {:?}, left out {:.1e}, {:.2} ms",
                r.elements,
                r.echoes,
                r.columns,
                r.rows,
                r.channels,
                r.products,
                r.passed_bins,
                r.entries,
                r.powers,
                r.orders,
                r.left_out,
                ms(r.stages.total()),
            );
        }
    }
}

#[derive(Default)]
struct Work {
    flops: f64,
    /// Number of bytes read or written once, without caches.
    bytes: f64,
}

impl Work {
    fn of(stage: Stage, r: &TaskReport) -> Self {
        let [columns, channels, rows, heard] =
            [r.columns, r.channels, r.rows, r.passed_bins].map(|n| n as f64);
        let [instants, along, turn] =
            [r.orders.instants, r.orders.along, r.orders.turn].map(|n| n as f64);
        let [entries, powers] = [r.entries, r.powers].map(|n| n as f64);
        let grid = columns * channels;
        let elements = r.elements as f64;
        let fft = |size: f64| 5.0 * size * size.max(1.0).log2();
        let (flops, values) = match stage {
            Stage::Transform => (grid * fft(rows), grid * (rows + heard)),
            Stage::Combine => {
                let pulses = instants * 4.0 * PULSE_POINTS;
                let sounds = instants * channels * 6.0;
                let shape = entries * 12.0;
                let turned = along * turn * 6.0;
                (
                    columns * heard * (pulses + sounds + shape + turned),
                    heard * grid,
                )
            }
            Stage::Elements => (
                // Two elements at a time: even and odd powers, then sums for two rotors.
                columns * heard * 0.5 * elements * (4.0 * powers + 16.0),
                heard * elements,
            ),
            Stage::Return => (elements * fft(rows / 1.5), elements * (heard + rows / 1.5)),
            Stage::Spread => (0.0, grid * rows),
            _ => (0.0, 0.0),
        };
        Self {
            flops,
            bytes: values * COMPLEX_BYTES,
        }
    }
}

/// Peak rates of one core.
struct Roofline {
    flops: f64,
    memory: f64,
    cache: f64,
}

impl Roofline {
    fn measure() -> Self {
        let flops = (0..5).map(|_| fused_per_s()).fold(0.0, f64::max);
        let pass = |values: usize, passes: usize| {
            let mut buffer = vec![1.0f32; values];
            (0..5)
                .map(|_| {
                    let start = Instant::now();
                    for _ in 0..passes {
                        for value in &mut buffer {
                            *value += 1.0;
                        }
                        black_box(&mut buffer);
                    }
                    // Read and written.
                    (8 * values * passes) as f64 / start.elapsed().as_secs_f64()
                })
                .fold(0.0, f64::max)
        };
        Self {
            flops,
            memory: pass(32 << 20, 1),
            cache: pass(1 << 18, 200),
        }
    }
}

const ROUNDS: usize = 2_000_000;
/// Number of independent sums, enough to hide the latency of a fused multiply-add.
const SUMS: usize = 12;

fn fused_per_s() -> f64 {
    let start = Instant::now();
    #[cfg(target_arch = "x86_64")]
    let lanes = if std::arch::is_x86_feature_detected!("avx512f") {
        // SAFETY: the CPU feature was just detected.
        unsafe { fused_avx512() };
        16
    } else if std::arch::is_x86_feature_detected!("fma") {
        // SAFETY: the CPU feature was just detected.
        unsafe { fused_avx2() };
        8
    } else {
        plain();
        1
    };
    #[cfg(not(target_arch = "x86_64"))]
    let lanes = {
        plain();
        1
    };
    (2 * lanes * SUMS * ROUNDS) as f64 / start.elapsed().as_secs_f64()
}

/// Intrinsics are used, because the compiler turns arrays into sixteen scalar multiplications.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn fused_avx512() {
    use std::arch::x86_64::{_mm512_fmadd_ps, _mm512_set1_ps};
    let (by, plus) = (_mm512_set1_ps(black_box(0.999)), _mm512_set1_ps(0.5));
    let mut sums = [_mm512_set1_ps(black_box(1.0)); SUMS];
    for _ in 0..ROUNDS {
        for sum in &mut sums {
            *sum = _mm512_fmadd_ps(*sum, by, plus);
        }
    }
    black_box(sums);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn fused_avx2() {
    use std::arch::x86_64::{_mm256_fmadd_ps, _mm256_set1_ps};
    let (by, plus) = (_mm256_set1_ps(black_box(0.999)), _mm256_set1_ps(0.5));
    let mut sums = [_mm256_set1_ps(black_box(1.0)); SUMS];
    for _ in 0..ROUNDS {
        for sum in &mut sums {
            *sum = _mm256_fmadd_ps(*sum, by, plus);
        }
    }
    black_box(sums);
}

fn plain() {
    let (by, plus) = (black_box(0.999f32), black_box(0.5f32));
    let mut sums = black_box([1.0f32; SUMS]);
    for _ in 0..ROUNDS {
        for sum in &mut sums {
            *sum = *sum * by + plus;
        }
    }
    black_box(sums);
}
