//! Colour maps in common use for sonar pictures.

use echotank_config::spec::ColourMap;

fn stops(map: ColourMap) -> &'static [[u8; 3]] {
    match map {
        ColourMap::Grey => &[[0, 0, 0], [255, 255, 255]],
        ColourMap::Copper => &[[0, 0, 0], [92, 46, 8], [196, 124, 28], [255, 244, 200]],
        ColourMap::Blue => &[[4, 8, 40], [16, 60, 150], [60, 190, 220], [255, 255, 255]],
        ColourMap::Rainbow => &[
            [24, 16, 120],
            [0, 110, 230],
            [0, 180, 90],
            [250, 230, 30],
            [210, 20, 20],
        ],
    }
}

/// Red, green and blue for a brightness from 0 to 1; values outside are clamped.
pub fn rgb(map: ColourMap, brightness: f32) -> [u8; 3] {
    let stops = stops(map);
    // NaN becomes the darkest colour.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_map_but_the_rainbow_grows_brighter_and_clamps_at_its_ends() {
        for map in [
            ColourMap::Grey,
            ColourMap::Copper,
            ColourMap::Blue,
            ColourMap::Rainbow,
        ] {
            assert_eq!(rgb(map, -3.0), rgb(map, 0.0));
            assert_eq!(rgb(map, f32::INFINITY), rgb(map, 1.0));
            if map == ColourMap::Rainbow {
                continue;
            }
            let brightness = |x: f32| {
                let [r, g, b] = rgb(map, x).map(f32::from);
                0.299 * r + 0.587 * g + 0.114 * b
            };
            for k in 0..100 {
                let (a, b) = (k as f32 / 100.0, (k + 1) as f32 / 100.0);
                assert!(brightness(b) >= brightness(a) - 0.6, "{map:?} at {a}");
            }
        }
    }
}
