//! Delays and weights of the elements for the points in focus of a ping.

use super::groups::BEAMS;
use super::interpolation::Interpolation;
use crate::beam::kernel::{BLOCK, Taps};
use echotank_config::spec::Former;

/// Minimum distance of a focal point, metres: keeps delays finite on the line itself.
pub(super) const MIN_DISTANCE_M: f64 = 1e-3;

/// Layout of a tap's rows in the grid.
#[derive(Clone, Copy)]
pub(super) struct GridLayout {
    pub(super) row: usize,
    /// Offset of the first sample to sum.
    pub(super) origin: usize,
}

/// Steering of the beams of one ping; pairs are components along the line and along the boresight.
pub(super) struct Steering {
    pub(super) former: Former,
    pub(super) transmit_m: [f64; 2],
    pub(super) velocity_m_per_s: [f64; 2],
    pub(super) c: f64,
    pub(super) carrier_hz: f64,
    pub(super) rate_hz: f64,
}

/// Focus of one beam: d = S - v t from the array's centre at reception.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Focus {
    pub(super) sine: f32,
    /// From the boresight, for places beside the line.
    pub(super) cosine: f32,
    /// R = |S|.
    pub(super) radius_m: f32,
    pub(super) d_m: [f32; 2],
    /// |d|.
    pub(super) range_m: f32,
}

impl Focus {
    /// Distance to an element, and the slope of its delay along the line (a sine).
    #[inline(always)]
    pub(super) fn leg(&self, x: f32) -> (f32, f32) {
        let q2 = self.range_m * self.range_m + x * (x - 2.0 * self.d_m[0]);
        let q = q2.max(1e-12).sqrt();
        (q, (x - self.d_m[0]) / q)
    }

    /// Delay of an element relative to the array's centre, times the sound speed; the slope along the line; and the inverse of the distance.
    #[inline(always)]
    pub(super) fn late_m(&self, [vx, vz]: [f32; 2], x: f32) -> (f32, f32, f32) {
        let [dx, dz] = self.d_m;
        let difference_m2 = x * (x - 2.0 * dx);
        let q2 = self.range_m * self.range_m + difference_m2;
        let q = q2.max(1e-12).sqrt();
        let per_q = 1.0 / q;
        let slope = (x - dx) * per_q;
        let opening = 1.0 + dz * vz * per_q - slope * vx;
        (difference_m2 / ((q + self.range_m) * opening), slope, per_q)
    }

    /// The same for an element with places along the line and along the boresight, with the slope along a tangent there.
    #[inline(always)]
    pub(super) fn late_m_of(
        &self,
        [vx, vz]: [f32; 2],
        [x, z]: [f32; 2],
        tangent: [f32; 2],
    ) -> (f32, f32, f32) {
        let [dx, dz] = self.d_m;
        let difference_m2 = x * (x - 2.0 * dx) + z * (z - 2.0 * dz);
        let q2 = self.range_m * self.range_m + difference_m2;
        let q = q2.max(1e-12).sqrt();
        let per_q = 1.0 / q;
        let [wx, wz] = [x - dx, z - dz];
        let opening = 1.0 - (wx * vx + wz * vz) * per_q;
        let late_m = difference_m2 / ((q + self.range_m) * opening);
        let slope = (wx * tangent[0] + wz * tangent[1]) * per_q;
        (late_m, slope, per_q)
    }

    /// Change of a slope for each change of the radius R, at a place along a tangent: t.w/q with w = place - d, of which d(t.w)/dR = -t.e and
    /// dq/dR = -w.e/q, where e points to the focus.
    #[inline(always)]
    pub(super) fn slope_per_radius(
        &self,
        [x, z]: [f32; 2],
        tangent: [f32; 2],
        (slope, per_q): (f32, f32),
    ) -> f32 {
        let along = |[x, z]: [f32; 2]| x * self.sine + z * self.cosine;
        let way = along([x - self.d_m[0], z - self.d_m[1]]);
        (slope * way * per_q - along(tangent)) * per_q
    }

    /// Distance to such a place, the slope of the delay along a tangent there (a sine), and the way from the focus to the place.
    #[inline(always)]
    pub(super) fn leg_of(&self, [x, z]: [f32; 2], tangent: [f32; 2]) -> (f32, f32, [f32; 2]) {
        let w = [x - self.d_m[0], z - self.d_m[1]];
        let q = (w[0] * w[0] + w[1] * w[1]).max(1e-12).sqrt();
        (q, (tangent[0] * w[0] + tangent[1] * w[1]) / q, w)
    }

    /// Delay of such a place for a point far away, times the sound speed.
    #[inline(always)]
    pub(super) fn far_late_m_of(&self, [x, z]: [f32; 2]) -> f32 {
        -(x * self.sine + z * self.cosine)
    }

    /// The same of a point far away.
    #[inline(always)]
    pub(super) fn far_late_m(&self, x: f32) -> f32 {
        -x * self.sine
    }
}

/// Several foci, structure of arrays.
pub(super) struct Foci {
    sine: [f32; BEAMS],
    cosine: [f32; BEAMS],
    radius_m: [f32; BEAMS],
    d_m: [[f32; BEAMS]; 2],
    range_m: [f32; BEAMS],
}

impl Foci {
    pub(super) const NONE: Self = Self {
        sine: [0.0; BEAMS],
        cosine: [0.0; BEAMS],
        radius_m: [0.0; BEAMS],
        d_m: [[0.0; BEAMS]; 2],
        range_m: [0.0; BEAMS],
    };

    #[inline(always)]
    pub(super) fn at(&self, i: usize) -> Focus {
        Focus {
            sine: self.sine[i],
            cosine: self.cosine[i],
            radius_m: self.radius_m[i],
            d_m: [self.d_m[0][i], self.d_m[1][i]],
            range_m: self.range_m[i],
        }
    }
}

impl Steering {
    /// The points in focus of some beams at `time_s`.
    #[inline(always)]
    pub(super) fn focus_all(&self, sines: &[f64; BEAMS], time_s: f64, foci: &mut Foci) {
        for (i, sine) in sines.iter().enumerate() {
            let focus = self.focus(*sine, time_s);
            foci.sine[i] = focus.sine;
            foci.cosine[i] = focus.cosine;
            foci.radius_m[i] = focus.radius_m;
            foci.d_m[0][i] = focus.d_m[0];
            foci.d_m[1][i] = focus.d_m[1];
            foci.range_m[i] = focus.range_m;
        }
    }

    #[inline(always)]
    pub(super) fn is_focused(&self) -> bool {
        self.former == Former::DynamicFocus
    }

    /// The point in focus of a beam at `time_s`. Beyond a sine of 1 it is the analytic continuation, for interpolation up to there.
    #[inline(always)]
    pub(super) fn focus(&self, sine: f64, time_s: f64) -> Focus {
        self.focus_towards([sine, (1.0 - sine * sine).max(0.0).sqrt()], time_s)
    }

    /// The same of a direction by its components along the line and along the boresight.
    #[inline(always)]
    pub(super) fn focus_towards(&self, toward: [f64; 2], time_s: f64) -> Focus {
        let [sine, cosine] = toward.map(|component| component as f32);
        if !self.is_focused() {
            return Focus {
                sine,
                cosine,
                ..Focus::default()
            };
        }
        let path_m = self.c * time_s;
        // S = R (sine, cosine) lies on the ellipse |S - p| + |S - q| = c t about the transmitter p and q = v t. With the difference of the squares
        // of its two legs, |S - p| = a + b R, which is squared once more.
        let (p, q) = (self.transmit_m, self.velocity_m_per_s.map(|v| v * time_s));
        let along = |[x, z]: [f64; 2]| x * toward[0] + z * toward[1];
        let square = |[x, z]: [f64; 2]| x * x + z * z;
        let per_path = 1.0 / path_m.max(MIN_DISTANCE_M);
        let a = 0.5 * (path_m + (square(p) - square(q)) * per_path);
        let b = (along(q) - along(p)) * per_path;
        let middle = along(p) + a * b;
        let scale = (1.0 - b * b).max(1e-3);
        let root = (middle * middle + scale * (a * a - square(p)))
            .max(0.0)
            .sqrt();
        let radius_m = ((middle + root) / scale).max(MIN_DISTANCE_M);
        let d = [radius_m * toward[0] - q[0], radius_m * toward[1] - q[1]];
        let range2 = radius_m * (radius_m - 2.0 * along(q)) + square(q);
        Focus {
            sine,
            cosine,
            radius_m: radius_m as f32,
            d_m: d.map(|x| x as f32),
            range_m: range2.max(MIN_DISTANCE_M * MIN_DISTANCE_M).sqrt() as f32,
        }
    }

    #[inline(always)]
    pub(super) fn cycles_per_m(&self) -> f32 {
        (self.carrier_hz / self.c) as f32
    }

    #[inline(always)]
    pub(super) fn mach(&self) -> [f32; 2] {
        self.velocity_m_per_s.map(|v| (v / self.c) as f32)
    }

    /// Delay of an element relative to the array's centre, times the sound speed.
    #[inline(always)]
    pub(super) fn late_m(&self, f: &Focus, x: f32) -> f32 {
        match self.is_focused() {
            true => f.late_m(self.mach(), x).0,
            false => f.far_late_m(x),
        }
    }

    /// The same of a place along the line and along the boresight.
    #[inline(always)]
    pub(super) fn late_m_of(&self, f: &Focus, place_m: [f32; 2]) -> f32 {
        match self.is_focused() {
            true => f.late_m_of(self.mach(), place_m, [0.0; 2]).0,
            false => f.far_late_m_of(place_m),
        }
    }

    /// Rows and weights of some elements. The carrier's phase is that of the delay beyond `reference_m`.
    #[inline(always)]
    pub(super) fn steer(
        &self,
        f: &Focus,
        (x_m, w): (&[f32], &[f32]),
        reference_m: f32,
        interpolation: &Interpolation,
        layout: GridLayout,
        taps: &mut Taps,
    ) {
        let mach = self.mach();
        let n = x_m.len().min(w.len()).min(BLOCK);
        let mut late_m = [0.0f32; BLOCK];
        let elements = late_m[..n].iter_mut().zip(x_m);
        // Outside the loops, so that they vectorise.
        match self.is_focused() {
            true => elements.for_each(|(late_m, x)| *late_m = f.late_m(mach, *x).0),
            false => elements.for_each(|(late_m, x)| *late_m = f.far_late_m(*x)),
        }
        self.taps((&late_m[..n], w), reference_m, interpolation, layout, taps);
    }

    /// As [`Self::steer`] for elements of an arc, at these places along its axis and along the boresight.
    #[inline(always)]
    pub(super) fn steer_arc(
        &self,
        f: &Focus,
        ([x_m, z_m], w): ([&[f32]; 2], &[f32]),
        reference_m: f32,
        interpolation: &Interpolation,
        layout: GridLayout,
        taps: &mut Taps,
    ) {
        let mach = self.mach();
        let n = x_m.len().min(z_m.len()).min(w.len()).min(BLOCK);
        let mut late_m = [0.0f32; BLOCK];
        let elements = late_m[..n].iter_mut().zip(x_m).zip(z_m);
        match self.is_focused() {
            true => elements
                .for_each(|((late_m, x), z)| *late_m = f.late_m_of(mach, [*x, *z], [0.0; 2]).0),
            false => elements.for_each(|((late_m, x), z)| *late_m = f.far_late_m_of([*x, *z])),
        }
        self.taps((&late_m[..n], w), reference_m, interpolation, layout, taps);
    }

    /// Rows and weights of elements with these delays.
    #[inline(always)]
    fn taps(
        &self,
        (late_m, w): (&[f32], &[f32]),
        reference_m: f32,
        interpolation: &Interpolation,
        layout: GridLayout,
        taps: &mut Taps,
    ) {
        let n = late_m.len().min(w.len()).min(BLOCK);
        let fractions = interpolation.fractions();
        let cycles_per_m = self.cycles_per_m();
        let steps_per_m = match self.former {
            Former::Phase => 0.0,
            _ => (self.rate_hz * fractions as f64 / self.c) as f32,
        };
        let element_rows = (fractions * 2 * layout.row) as i32;
        let (row, origin) = (2 * layout.row as i32, layout.origin as i32);
        let (mask, shift) = (fractions as i32 - 1, fractions.trailing_zeros());
        let start = |i: usize, step: i32| {
            (i as i32 * element_rows + (step & mask) * row + origin + (step >> shift)) as u32
        };
        if interpolation.is_linear {
            taps.len = 2 * n;
            let (first, second) = taps.start.split_at_mut(n);
            let (re, re_next) = taps.re.split_at_mut(n);
            let (im, im_next) = taps.im.split_at_mut(n);
            for i in 0..n {
                let (sin, cos) = turn((late_m[i] - reference_m) * cycles_per_m);
                let at = late_m[i] * steps_per_m;
                let step = whole_number(at - 0.5);
                let next = w[i] * (at - step as f32);
                let near = w[i] - next;
                first[i] = start(i, step);
                second[i] = start(i, step + 1);
                (re[i], im[i]) = (near * cos, near * sin);
                (re_next[i], im_next[i]) = (next * cos, next * sin);
            }
        } else {
            taps.len = n;
            for i in 0..n {
                let (sin, cos) = turn((late_m[i] - reference_m) * cycles_per_m);
                taps.start[i] = start(i, whole_number(late_m[i] * steps_per_m));
                taps.re[i] = w[i] * cos;
                taps.im[i] = w[i] * sin;
            }
        }
    }
}

/// 1.5 * 2^23: adding it removes the fractional part of an f32.
const SHIFT: f32 = 12_582_912.0;

/// The nearest integer, from the last bits of the shifted value.
#[inline(always)]
pub(super) fn whole_number(x: f32) -> i32 {
    (x + SHIFT).to_bits() as i32 - SHIFT.to_bits() as i32
}

/// Rounds a value within 2^22 to the nearest integer (halves to even) without a function call, so that loops vectorise.
#[inline(always)]
fn round(x: f32) -> f32 {
    (x + SHIFT) - SHIFT
}

/// Sine and cosine of a number of cycles, with an error of 3e-7.
#[inline(always)]
pub(super) fn turn(cycles: f32) -> (f32, f32) {
    // Reduces to a quarter turn, then uses a Taylor series over an eighth of a turn to either side.
    let quarter = round(4.0 * cycles);
    let a = (cycles - 0.25 * quarter) * std::f32::consts::TAU;
    let a2 = a * a;
    let sin = a * (1.0 + a2 * (-1.0 / 6.0 + a2 * (1.0 / 120.0 + a2 * (-1.0 / 5040.0))));
    let cos = 1.0 + a2 * (-0.5 + a2 * (1.0 / 24.0 + a2 * (-1.0 / 720.0 + a2 * (1.0 / 40320.0))));
    // Without a branch, which AVX2 would not vectorise.
    let k = whole_number(4.0 * cycles) as u32;
    let swaps = 0u32.wrapping_sub(k & 1);
    let (sin, cos) = (sin.to_bits(), cos.to_bits());
    let swapped = (sin ^ cos) & swaps;
    let s = f32::from_bits((sin ^ swapped) ^ (k & 2) << 30);
    let c = f32::from_bits((cos ^ swapped) ^ (k.wrapping_add(1) & 2) << 30);
    (s, c)
}
