//! Four channels of three pings as SigMF, and eight channels as WAV: i16 in RIFF, i32 in RF64, f32 in RIFF.

use std::path::Path;

use echotank_protocols::sigmf::{Annotation, Capture, DataType, Recording};
use echotank_protocols::wav::{Container, WavFormat, WavSample};

use super::*;

const SAMPLES: u64 = 500;

pub(crate) fn write(folder: &Path) -> std::io::Result<()> {
    let recording = Recording {
        data_type: DataType::ComplexI16,
        sample_rate_hz: 50e3,
        channels: 4,
        hardware: "simulated".into(),
        description: "three pings of four elements".into(),
        recorder: "echotank".into(),
        captures: (0..3)
            .map(|p| Capture {
                sample_start: p * SAMPLES,
                frequency_hz: Some(430e3),
                utc_ns: UTC_NS + p as i64 * 100_000_000,
            })
            .collect(),
        annotations: (0..3)
            .map(|p| Annotation {
                sample_start: p * SAMPLES,
                sample_count: SAMPLES,
                label: format!("ping {}", p + 1),
                comment: String::new(),
                band_hz: Some((420e3, 440e3)),
            })
            .collect(),
    };
    std::fs::write(folder.join("sample.sigmf-meta"), recording.to_json())?;
    let mut data = Vec::new();
    for p in 0..3 {
        for k in 0..SAMPLES {
            for c in 0..4 {
                data.extend(count(p, c, 2 * k).to_le_bytes());
                data.extend(count(p, c, 2 * k + 1).to_le_bytes());
            }
        }
    }
    std::fs::write(folder.join("sample.sigmf-data"), data)?;

    for (name, sample, container) in [
        ("sample_i16.wav", WavSample::I16, Container::AsNeeded),
        ("sample_i32_rf64.wav", WavSample::I32, Container::Rf64),
        ("sample_f32.wav", WavSample::F32, Container::AsNeeded),
    ] {
        let format = WavFormat {
            channels: 8,
            sample_rate_hz: 192_000,
            sample,
        };
        let mut file = Vec::new();
        format.emit_header(&mut file, SAMPLES, container);
        for k in 0..SAMPLES {
            for c in 0..8 {
                let n = count(0, c, k);
                match sample {
                    WavSample::I16 => file.extend(n.to_le_bytes()),
                    WavSample::I32 => file.extend((i32::from(n) * 65_536).to_le_bytes()),
                    WavSample::F32 => file.extend((f32::from(n) / 32_768.0).to_le_bytes()),
                }
            }
        }
        std::fs::write(folder.join(name), file)?;
    }
    Ok(())
}
