//! Apertures on an arc of elements: each beam uses the elements whose normals lie within half the aperture of its direction.

use std::ops::Range;

use crate::beam::directions::half_power_sine;
use crate::beam::weights::Taper;
use echotank_config::spec::FanSpec;
use echotank_core::arrays::ArrayGeometry;

/// Elements of the beams of one fan. The weights of a beam, tapered over its aperture, have the sum 1; at the ends of the arc, apertures are cut off.
pub(crate) struct ArcApertures {
    radius_m: f64,
    aperture_rad: f64,
    /// Angle of each element's normal from the boresight towards +x.
    normal_rad: Vec<f64>,
    taper: Taper,
    pub(super) beams: Vec<ArcBeam>,
    /// Of the elements of all beams.
    weights: Vec<f32>,
    /// Places across the axis of a beam and weights of its elements.
    own: Vec<(f64, f64)>,
    /// Half the -3 dB width of a whole aperture as a sine, times the standard deviation of its elements across the beam in wavelengths.
    half_width: f64,
    /// A line about the axis of its beam with half this length has the largest error of focus, metres.
    pub(super) half_m: f64,
    /// Largest distance of an element in use from the axis of its beam, metres.
    pub(super) reach_m: f64,
}

/// One beam.
pub(super) struct ArcBeam {
    pub(super) elements: Range<usize>,
    /// The first element of its second half.
    pub(super) middle: usize,
    first_weight: usize,
    /// Weighted standard deviation of the elements across the beam, metres.
    deviation_m: f64,
}

impl ArcBeam {
    /// The elements of each section.
    pub(super) fn sections(&self, has_halves: bool) -> impl Iterator<Item = Range<usize>> + use<> {
        let Range { start, end } = self.elements;
        let middle = if has_halves { self.middle } else { end };
        [start..middle, middle..end]
            .into_iter()
            .take(if has_halves { 2 } else { 1 })
    }
}

impl ArcApertures {
    /// None for a straight line. The directions of the beams are set by [`Self::aim`].
    pub(crate) fn new(array: &ArrayGeometry, fan: &FanSpec) -> Option<Self> {
        let radius_m = array.radius_m?;
        let normals = (0..array.elements).map(|e| array.along_m(e) / radius_m);
        let taper = Taper::new(fan.shading);
        let aperture_rad = fan.form.aperture_rad;
        // Elements of a whole aperture.
        let half = (0.5 * aperture_rad * radius_m / array.spacing_m).floor() as i32;
        let places = (-half..=half).map(|e| f64::from(e) * array.spacing_m / radius_m);
        let whole: Vec<(f64, f64)> = places
            .map(|rad| (radius_m * rad.sin(), taper.at(rad / aperture_rad)))
            .collect();
        let deviation_m = deviation_m(&whole);
        let sum: f64 = whole.iter().map(|(_, weight)| weight).sum();
        let weights: Vec<f64> = whole.iter().map(|(_, weight)| weight / sum).collect();
        Some(Self {
            radius_m,
            aperture_rad,
            normal_rad: normals.collect(),
            taper,
            beams: Vec::with_capacity(fan.beams),
            weights: Vec::with_capacity(fan.beams * array.elements),
            own: Vec::with_capacity(array.elements),
            half_width: half_power_sine(&weights, |e| whole[e].0 / deviation_m),
            half_m: 0.0,
            reach_m: 0.0,
        })
    }

    /// Selects the elements of beams towards these sines, and their weights.
    pub(crate) fn aim(&mut self, sines: &[f64]) {
        self.beams.clear();
        self.weights.clear();
        self.reach_m = 0.0;
        let mut square_m2 = 0.0f64;
        let last = self.normal_rad.len() - 1;
        for sine in sines {
            let angle_rad = sine.clamp(-1.0, 1.0).asin();
            let cosine = (1.0 - sine * sine).max(0.0).sqrt();
            let looks_there =
                |rad: &f64| (rad - angle_rad).abs() <= 0.5 * self.aperture_rad * (1.0 + 1e-9);
            let first = self
                .normal_rad
                .partition_point(|rad| *rad < angle_rad && !looks_there(rad));
            let count = self.normal_rad[first..]
                .iter()
                .take_while(|rad| looks_there(rad));
            // At least the element that looks there most.
            let elements = match count.count() {
                0 => first.min(last)..first.min(last) + 1,
                count => first..first + count,
            };
            let normals = &self.normal_rad[elements.clone()];
            let across_m = |rad: &f64| {
                let (sin, cos) = rad.sin_cos();
                self.radius_m * (sin * cosine - (cos - 1.0) * sine)
            };
            let own = &mut self.own;
            own.clear();
            own.extend(normals.iter().map(|rad| {
                let weight = self.taper.at((rad - angle_rad) / self.aperture_rad);
                (across_m(rad), weight)
            }));
            let sum: f64 = own.iter().map(|(_, weight)| weight).sum();
            // Elements from y - h to y + h across the axis: squares differ from y^2, which is common to all, by h (h + 2 |y|) at most.
            let [a, b] = [0, own.len() - 1].map(|e| own[e].0);
            let (middle_m, half_m) = (0.5 * (a + b), 0.5 * (b - a).abs());
            self.reach_m = self.reach_m.max(half_m + middle_m.abs());
            square_m2 = square_m2.max(half_m * (half_m + 2.0 * middle_m.abs()));
            let before = own.iter().scan(0.0, |sum: &mut f64, (_, weight)| {
                *sum += weight;
                Some(*sum)
            });
            let middle = before.take_while(|before| *before < 0.5 * sum).count() + 1;
            self.beams.push(ArcBeam {
                middle: elements.start + middle.min(elements.len()),
                first_weight: self.weights.len(),
                elements,
                deviation_m: deviation_m(own),
            });
            self.weights
                .extend(own.iter().map(|(_, weight)| (weight / sum) as f32));
        }
        self.half_m = square_m2.sqrt();
    }

    /// Weights of some of the elements of a beam.
    pub(super) fn weights(&self, beam: &ArcBeam, elements: Range<usize>) -> &[f32] {
        let first = beam.first_weight + elements.start - beam.elements.start;
        &self.weights[first..first + elements.len()]
    }

    /// -3 dB width of every beam, radians.
    pub(crate) fn widths_rad(&self, wavelength_m: f64, widths: &mut [f64]) {
        for (width, beam) in widths.iter_mut().zip(&self.beams) {
            *width = self.width_rad(beam, wavelength_m);
        }
    }

    pub(super) fn width_rad(&self, beam: &ArcBeam, wavelength_m: f64) -> f64 {
        let half = self.half_width * wavelength_m / beam.deviation_m.max(f64::MIN_POSITIVE);
        2.0 * half.min(1.0).asin()
    }

    /// Angle between the normals of the outermost elements of a whole aperture.
    pub(super) fn aperture_rad(&self) -> f64 {
        self.aperture_rad
    }

    /// Elements of all beams together.
    pub(super) fn terms(&self) -> usize {
        self.weights.len()
    }
}

/// Of places with weights.
fn deviation_m(places: &[(f64, f64)]) -> f64 {
    let sum = |of: &dyn Fn(f64) -> f64| -> f64 {
        places
            .iter()
            .map(|(place, weight)| weight * of(*place))
            .sum()
    };
    let all = sum(&|_| 1.0);
    let mean = sum(&|place| place) / all;
    (sum(&|place| (place - mean) * (place - mean)) / all).sqrt()
}
