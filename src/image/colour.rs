//! Colour maps that sonar people use.

pub use crate::config::spec::ColourMap;

impl ColourMap {
    pub const ALL: [Self; 4] = [Self::Grey, Self::Copper, Self::Blue, Self::Rainbow];

    pub fn name(self) -> &'static str {
        match self {
            Self::Grey => "grey",
            Self::Copper => "copper",
            Self::Blue => "blue",
            Self::Rainbow => "rainbow",
        }
    }

    fn stops(self) -> &'static [[u8; 3]] {
        match self {
            Self::Grey => &[[0, 0, 0], [255, 255, 255]],
            Self::Copper => &[[0, 0, 0], [92, 46, 8], [196, 124, 28], [255, 244, 200]],
            Self::Blue => &[[4, 8, 40], [16, 60, 150], [60, 190, 220], [255, 255, 255]],
            Self::Rainbow => &[
                [24, 16, 120],
                [0, 110, 230],
                [0, 180, 90],
                [250, 230, 30],
                [210, 20, 20],
            ],
        }
    }

    /// Of a brightness from 0 to 1; held outside.
    pub fn at(self, brightness: f32) -> [u8; 3] {
        let stops = self.stops();
        // What is no number is darkest.
        let share = match brightness.is_nan() {
            true => 0.0,
            false => brightness.clamp(0.0, 1.0),
        };
        let x = share * (stops.len() - 1) as f32;
        let k = (x as usize).min(stops.len() - 2);
        let share = x - k as f32;
        std::array::from_fn(|i| {
            let (a, b) = (f32::from(stops[k][i]), f32::from(stops[k + 1][i]));
            (a + (b - a) * share).round() as u8
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_map_grows_brighter_but_the_rainbow_and_holds_its_ends() {
        for map in ColourMap::ALL {
            assert_eq!(map.at(-3.0), map.at(0.0));
            assert_eq!(map.at(f32::INFINITY), map.at(1.0));
            if map == ColourMap::Rainbow {
                continue;
            }
            let brightness = |x: f32| {
                let [r, g, b] = map.at(x).map(f32::from);
                0.299 * r + 0.587 * g + 0.114 * b
            };
            for k in 0..100 {
                let (a, b) = (k as f32 / 100.0, (k + 1) as f32 / 100.0);
                assert!(
                    brightness(b) >= brightness(a) - 0.6,
                    "{} at {a}",
                    map.name()
                );
            }
        }
    }
}
