//! Checks `[sonar.instrument]`, and reads its files.

use super::super::spec::*;
use super::all;
use crate::files::Files;
use crate::keys;
use crate::keys::instrument as table;
use crate::raw::{Entry, Field, Problems};
use echotank_core::instrument::{
    Crosstalk, ElementError, ElementSpread, Instrument, Leakage, Resonance, ResponsePoint,
    SecondSonar, Tone, ToneEntry, TransducerResponse,
};
use echotank_core::pulse::{Pulse, PulseKind};

/// Farthest band of a second sonar from the centre frequency, sample rates: the receiver filter is computed for such a band.
const MAX_APART: f64 = 6.0;
/// Maximum number of points of a response.
const MAX_POINTS: usize = 10_000;
/// Seed of the element errors by default.
const SEED: u64 = 1;

/// Thermal noise (Mellen 1952), and noise of the surface by wind (Wenz 1962), at a frequency, dB re 1 uPa^2/Hz, of an omnidirectional element: Coates
/// 1990, N_th = -15 + 20 log f, N_w = 50 + 7.5 sqrt(w) + 20 log f - 40 log (f + 0.4), f in kHz and w in m/s.
pub(super) fn ambient_noise_db(frequency_hz: f64, wind_m_per_s: f64) -> f64 {
    let khz = 1e-3 * frequency_hz;
    let thermal_db = -15.0 + 20.0 * libm::log10(khz);
    let surface_db =
        50.0 + 7.5 * wind_m_per_s.sqrt() + 20.0 * libm::log10(khz) - 40.0 * libm::log10(khz + 0.4);
    let power = libm::exp10(0.1 * thermal_db) + libm::exp10(0.1 * surface_db);
    10.0 * libm::log10(power)
}

/// The imperfections of a sonar; `None` without any, or if a problem is listed.
pub(super) fn instrument(
    sonar_table: &keys::Sonar,
    sonar: &SonarSpec,
    files: &dyn Files,
    problems: &mut Problems,
) -> Option<Instrument> {
    let field = &sonar_table.instrument;
    let t = field.as_ref().filter(|_| field.given)?;
    let ring_down = ring_down(t, sonar);
    let leakage = t.leakage_db.if_given()?.map(|level_db| Leakage {
        level_db,
        ring_down,
    });
    let response = t
        .response
        .given_and_then(|r| response(r, &t.response, sonar, files, problems));
    let spread = element_spread(t, sonar, files, problems);
    let tones = t.tone.all().iter().map(tone).collect();
    let second_sonars = t.second_sonar.all().iter();
    let second_sonars = second_sonars.map(|s| second_sonar(s, sonar, problems));
    let instrument = Instrument {
        leakage,
        crosstalk: Crosstalk {
            elements_db: t.crosstalk_elements_db.if_given()?,
            arrays_db: t.crosstalk_arrays_db.if_given()?,
        },
        second_sonars: all(second_sonars.collect())?,
        response: response?,
        element_spread: spread?,
        tones: all(tones)?,
    };
    if instrument.crosstalk.arrays_db.is_some() && sonar.receive.len() < 2 {
        let rule = "needs at least two receive arrays";
        problems.refuse(&t.crosstalk_arrays_db, rule);
    }
    (instrument != Instrument::default()).then_some(instrument)
}

fn ring_down(t: &table::Instrument, sonar: &SonarSpec) -> Option<Resonance> {
    let frequency_hz = t.ring_down_khz.get();
    t.ring_down_q.get().map(|q| Resonance {
        q,
        frequency_hz: frequency_hz.unwrap_or(sonar.pulse.center_frequency_hz),
    })
}

fn response(
    t: &table::Response,
    entry: &Entry,
    sonar: &SonarSpec,
    files: &dyn Files,
    problems: &mut Problems,
) -> Option<TransducerResponse> {
    match (t.q.given, t.file.given) {
        (true, false) => Some(TransducerResponse::Resonance(Resonance {
            q: t.q.get()?,
            frequency_hz: t
                .resonance_khz
                .if_given()?
                .unwrap_or(sonar.pulse.center_frequency_hz),
        })),
        (false, true) => {
            let rows = rows(
                &t.file,
                "a frequency in kHz, dB and degrees",
                files,
                problems,
            )?;
            let points = response_points(&rows, &sonar.pulse);
            let refuse = |why| problems.refuse(&t.file, why);
            points.map_err(refuse).map(TransducerResponse::Table).ok()
        }
        _ => {
            problems.refuse(entry, "must have either `q` or `file`");
            None
        }
    }
}

/// Points of a response in ascending order that cover the band of the pulse.
fn response_points(rows: &[Row], pulse: &Pulse) -> Result<Vec<ResponsePoint>, String> {
    if rows.len() < 2 || rows.len() > MAX_POINTS {
        return Err(format!(
            "{} lines of numbers: must be 2 to {MAX_POINTS}",
            rows.len()
        ));
    }
    let mut points: Vec<ResponsePoint> = Vec::new();
    for row in rows {
        let [khz, level_db, phase_deg] = row.numbers()?;
        let frequency_hz = 1e3 * khz;
        let before_hz = points.last().map_or(0.0, |point| point.frequency_hz);
        if frequency_hz <= before_hz {
            return Err(format!(
                "line {}: {khz} kHz: must be greater than {} kHz, the frequency before",
                row.line,
                1e-3 * before_hz
            ));
        }
        points.push(ResponsePoint {
            frequency_hz,
            level_db,
            phase_rad: phase_deg.to_radians(),
        });
    }
    let half_hz = 0.5 * pulse.bandwidth_hz;
    let [low_hz, high_hz] = [-half_hz, half_hz].map(|off| pulse.center_frequency_hz + off);
    let [first_hz, last_hz] = [0, points.len() - 1].map(|end| points[end].frequency_hz);
    if first_hz > low_hz || last_hz < high_hz {
        return Err(format!(
            "{} to {} kHz: must cover the band of the pulse, {} to {} kHz",
            1e-3 * first_hz,
            1e-3 * last_hz,
            1e-3 * low_hz,
            1e-3 * high_hz
        ));
    }
    Ok(points)
}

fn element_spread(
    t: &table::Instrument,
    sonar: &SonarSpec,
    files: &dyn Files,
    problems: &mut Problems,
) -> Option<ElementSpread> {
    let random = [&*t.element_gain_db, &*t.element_phase_deg, &*t.element_seed];
    problems.only_with(&random, Some(!t.element_file.given), "no element_file");
    let measured = t.element_file.given_and_then(|_| {
        let what = "a receive array, an element, dB and degrees";
        let rows = rows(&t.element_file, what, files, problems)?;
        let errors = rows.iter().map(|row| element_error(row, sonar));
        let refuse = |why| problems.refuse(&t.element_file, why);
        errors.collect::<Result<_, _>>().map_err(refuse).ok()
    });
    Some(ElementSpread {
        gain_db: t.element_gain_db.if_given()?.unwrap_or(0.0),
        phase_rad: t.element_phase_deg.if_given()?.unwrap_or(0.0),
        seed: match t.element_seed.given {
            true if t.element_gain_db.given || t.element_phase_deg.given => t.element_seed.to()?,
            true => {
                let rule = "only with element_gain_db or element_phase_deg";
                problems.refuse(&t.element_seed, rule);
                return None;
            }
            false if t.element_gain_db.given || t.element_phase_deg.given => SEED,
            false => 0,
        },
        measured: measured?.unwrap_or_default(),
    })
}

fn element_error(row: &Row, sonar: &SonarSpec) -> Result<ElementError, String> {
    let line = row.line;
    let name = row.cells.first().map_or("", String::as_str);
    let array = sonar.receive_names.iter().position(|known| known == name);
    let array = array.ok_or_else(|| {
        let names = sonar.receive_names.join(", ");
        format!("line {line}: {name:?}: must be the name of a receive array: {names}")
    })?;
    let [element, gain_db, phase_deg] = row.numbers_from(1)?;
    let elements = sonar.receive[array].elements;
    if element < 0.0 || element.fract() != 0.0 || element >= elements as f64 {
        let last = elements - 1;
        return Err(format!(
            "line {line}: element {element}: must be a whole number from 0 to {last}"
        ));
    }
    Ok(ElementError {
        array,
        element: element as usize,
        gain_db,
        phase_rad: phase_deg.to_radians(),
    })
}

fn tone(t: &table::Tone) -> Option<Tone> {
    Some(Tone {
        frequency_hz: t.frequency_khz.get()?,
        level_db: t.level_db.get()?,
        phase_rad: t.phase_deg.get()?,
        entry: match t.entry.text()? {
            "baseband" => ToneEntry::Baseband,
            _ => ToneEntry::Input,
        },
    })
}

fn second_sonar(
    t: &table::SecondSonar,
    sonar: &SonarSpec,
    problems: &mut Problems,
) -> Option<SecondSonar> {
    let kind = match (t.kind.text()?, t.sweep.text()?) {
        ("cw", _) => PulseKind::Cw,
        (_, "down") => PulseKind::LfmDown,
        _ => PulseKind::LfmUp,
    };
    let pulse = Pulse {
        kind,
        center_frequency_hz: t.center_frequency_khz.get()?,
        bandwidth_hz: match kind {
            PulseKind::Cw => 0.0,
            _ => t.bandwidth_khz.get()?,
        },
        duration_s: t.duration_ms.get()?,
        taper: t.taper.get()?,
    };
    let own_hz = sonar.pulse.center_frequency_hz;
    let reach_hz = (pulse.center_frequency_hz - own_hz).abs() + 0.5 * pulse.bandwidth_hz;
    let max_hz = MAX_APART * sonar.receiver.sample_rate_hz;
    if reach_hz > max_hz {
        let rule = format!(
            "must keep its band within {} kHz of sonar.pulse.center_frequency_khz = {}: the receiver does not receive it",
            1e-3 * max_hz,
            1e-3 * own_hz
        );
        problems.refuse(&t.center_frequency_khz, rule);
    }
    let period_s = t.period_ms.get()?;
    if period_s <= pulse.duration_s {
        problems.refuse(&t.period_ms, "must be longer than duration_ms");
    }
    Some(SecondSonar {
        pulse,
        period_s,
        offset_s: t.offset_ms.get()?,
        drift_ppm: t.drift_ppm.get()?,
        bearing_rad: t.bearing_deg.get()?,
        depression_rad: t.depression_deg.get()?,
        level_db: t.level_db.get()?,
    })
}

// ---------------------------------------------------------------- files

/// A line of cells, with its number from 1.
struct Row {
    line: usize,
    cells: Vec<String>,
    /// Contents of a line, for messages.
    what: &'static str,
}

impl Row {
    fn numbers<const N: usize>(&self) -> Result<[f64; N], String> {
        self.numbers_from(0)
    }

    /// Finite numbers of `N` cells.
    fn numbers_from<const N: usize>(&self, first: usize) -> Result<[f64; N], String> {
        let cells = self.cells.iter().skip(first);
        let numbers: Vec<f64> = cells
            .map_while(|cell| cell.parse().ok())
            .filter(|number: &f64| number.is_finite())
            .take(N)
            .collect();
        numbers.try_into().map_err(|_| {
            let (line, what) = (self.line, self.what);
            format!("line {line}: {:?}: must be {what}", self.cells.join(","))
        })
    }
}

/// Lines of a text file with cells separated by commas, semicolons, tabs or spaces. Empty lines, lines that begin with `#`, and a first line of column
/// names are ignored.
fn rows(
    key: &Field<std::path::PathBuf>,
    what: &'static str,
    files: &dyn Files,
    problems: &mut Problems,
) -> Option<Vec<Row>> {
    let bytes = match files.read(key.as_ref()?) {
        Ok(bytes) => bytes,
        Err(why) => {
            problems.refuse(key, format!("cannot be read: {why}"));
            return None;
        }
    };
    let text = String::from_utf8_lossy(&bytes);
    let text = text.trim_start_matches('\u{feff}');
    let rows = (1..).zip(text.lines().map(str::trim));
    let rows = rows.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let rows = rows.map(|(line, text)| Row {
        line,
        cells: text
            .split([',', ';', '\t', ' '])
            .filter(|cell| !cell.is_empty())
            .map(str::to_owned)
            .collect(),
        what,
    });
    let is_heading = |row: &Row| row.cells.iter().all(|cell| cell.parse::<f64>().is_err());
    let mut rows: Vec<Row> = rows.collect();
    if rows.first().is_some_and(is_heading) {
        rows.remove(0);
    }
    Some(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Thermal noise from physics, p^2 = 4 pi k T rho f^2 / c (Mellen 1952), in water of 10 degrees.
    #[test]
    fn ambient_noise_is_that_of_molecules_at_high_and_of_the_surface_at_low_frequencies() {
        for hz in [300e3, 500e3, 1e6] {
            let pa2_per_hz =
                4.0 * std::f64::consts::PI * 1.380_649e-23 * 283.15 * 1027.0 * hz * hz / 1490.0;
            let want_db = 10.0 * (1e12 * pa2_per_hz).log10();
            let got_db = ambient_noise_db(hz, 0.0);
            assert!((got_db - want_db).abs() < 0.5, "{hz}: {got_db} {want_db}");
        }
        // Knudsen, Alford and Emling 1948 in the fit 56 + 19 log10(sea state) - 17 log10(kHz): sea state 3 is a wind of 7 m/s.
        for khz in [3.0, 10.0, 20.0_f64] {
            let want_db = 56.0 + 19.0 * 3f64.log10() - 17.0 * khz.log10();
            let got_db = ambient_noise_db(1e3 * khz, 7.0);
            assert!((got_db - want_db).abs() < 2.5, "{khz}: {got_db} {want_db}");
        }
        // 7.5 dB between 1 and 4 m/s where wind alone counts.
        let rise_db = ambient_noise_db(5e3, 4.0) - ambient_noise_db(5e3, 1.0);
        assert!((rise_db - 7.5).abs() < 0.1, "{rise_db}");
    }
}
