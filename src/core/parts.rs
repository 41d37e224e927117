//! Line arrays in parts. A part combines adjacent elements into one element at their centre.

use crate::arrays::{ArrayGeometry, Pattern};
use crate::ping::MethodMark;

impl Pattern {
    /// Number of elements that the pattern represents: 1 except for [`Pattern::Part`].
    pub fn stands_for(&self) -> usize {
        match *self {
            Self::Part { elements, .. } => elements,
            _ => 1,
        }
    }
}

impl ArrayGeometry {
    /// The line array with every `of` elements combined into one. `None` if `of` does not divide the number of elements, if the line
    /// is already in parts, and on an arc.
    pub fn in_parts(&self, of: usize) -> Option<Self> {
        let (length_m, width_m, baffled) = match self.element_pattern {
            Pattern::Omnidirectional => (0.0, 0.0, false),
            Pattern::Rectangle {
                length_m,
                width_m,
                baffled,
            } => (length_m, width_m, baffled),
            Pattern::Part { .. } => return None,
        };
        if of < 2 || !self.elements.is_multiple_of(of) || self.radius_m.is_some() {
            return None;
        }
        Some(Self {
            elements: self.elements / of,
            spacing_m: self.spacing_m * of as f64,
            element_pattern: Pattern::Part {
                elements: of,
                spacing_m: self.spacing_m,
                length_m,
                width_m,
                baffled,
            },
            ..self.clone()
        })
    }

    /// The line array of single elements behind a line in parts. Any other line is returned unchanged.
    pub fn whole(&self) -> Self {
        let Pattern::Part {
            elements,
            spacing_m,
            length_m,
            width_m,
            baffled,
        } = self.element_pattern
        else {
            return self.clone();
        };
        Self {
            elements: self.elements * elements,
            spacing_m,
            element_pattern: Pattern::Rectangle {
                length_m,
                width_m,
                baffled,
            },
            ..self.clone()
        }
    }
}

impl MethodMark {
    /// Name in the configuration.
    pub fn output(&self) -> &'static str {
        match self.part_elements {
            1 => "elements",
            _ => "beams",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arrays::Mounting;
    use glam::{DQuat, DVec3};

    #[test]
    fn a_part_is_at_the_centre_of_its_elements_and_whole_restores_them() {
        let line = ArrayGeometry {
            mounting: Mounting {
                position_m: DVec3::new(1.0, -2.0, 0.5),
                body_from_array: DQuat::from_rotation_z(0.3),
            },
            elements: 24,
            spacing_m: 0.0125,
            radius_m: None,
            element_pattern: Pattern::Rectangle {
                length_m: 0.01,
                width_m: 0.02,
                baffled: true,
            },
            sensitivity_db: -190.0,
            transmit: 0,
        };
        for of in [2, 3, 4, 6, 8, 12, 24] {
            let parts = line.in_parts(of).expect("even");
            assert_eq!(
                (parts.elements, parts.element_pattern.stands_for()),
                (24 / of, of)
            );
            assert_eq!(parts.whole(), line);
            for part in 0..parts.elements {
                let mean = (0..of).map(|j| line.element_body_m(part * of + j));
                let mean = mean.sum::<DVec3>() / of as f64;
                assert!(mean.distance(parts.element_body_m(part)) < 1e-14);
            }
            assert!(parts.in_parts(1).is_none() && parts.in_parts(2).is_none());
        }
        assert!(
            line.in_parts(5).is_none() && line.in_parts(1).is_none() && line.in_parts(48).is_none()
        );
        assert_eq!(line.whole(), line);
    }
}
