//! Writes pictures as PNG files, row by row.

use std::path::Path;

use ::png::{BitDepth, ColorType, Encoder, EncodingError};
use std::io::Write;

use super::{PartialFile, RecordError};
use echotank_imaging::image::waterfall::Waterfall;

/// Writes the complete picture. Returns false and writes nothing if there are no pings.
pub(crate) fn write_waterfall(path: &Path, waterfall: &Waterfall) -> Result<bool, RecordError> {
    if waterfall.pings() == 0 {
        return Ok(false);
    }
    let mut target = PartialFile::create(path)?;
    encode(&mut target.file, waterfall).map_err(|e| {
        RecordError::io(&target.partial, "write")(match e {
            EncodingError::IoError(e) => e,
            other => std::io::Error::other(other),
        })
    })?;
    target.keep(path)?;
    Ok(true)
}

fn encode(to: impl Write, waterfall: &Waterfall) -> Result<(), EncodingError> {
    let size = |n: usize| u32::try_from(n).map_err(std::io::Error::other);
    let mut encoder = Encoder::new(to, size(waterfall.width())?, size(waterfall.height())?);
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    encoder.add_text_chunk(
        "Description".into(),
        format!(
            "Side-scan waterfall: port left, starboard right, newest ping at the top, {} m of slant range per pixel",
            waterfall.spec().metres_per_pixel
        ),
    )?;
    let mut writer = encoder.write_header()?;
    let mut rows = writer.stream_writer()?;
    waterfall.render(|row| rows.write_all(row))?;
    rows.finish()?;
    writer.finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::record::testing::plan;
    use echotank_core::ping::{Line, Side};
    use echotank_imaging::image::waterfall::WaterfallSpec;

    fn waterfall() -> Waterfall {
        let spec = WaterfallSpec {
            range_m: 20.0,
            rows_per_ping: 2,
            range_ticks_m: Some(5.0),
            ..WaterfallSpec::default()
        };
        let mut waterfall = Waterfall::new(spec, 40e3);
        for ping in 1..=9 {
            let amplitude: Vec<f32> = (0..1100)
                .map(|k| 1.0 / (1.0 + (k * ping as usize) as f32))
                .collect();
            let lines = [Side::Port, Side::Starboard].map(|side| Line {
                side,
                amplitude: amplitude.clone(),
            });
            waterfall.push(&plan(ping), &lines);
        }
        waterfall
    }

    #[test]
    fn file_holds_the_pixels_that_were_drawn() {
        let dir = tempfile::tempdir().expect("dir");
        let path = dir.path().join("waterfall.png");
        let waterfall = waterfall();
        assert!(write_waterfall(&path, &waterfall).expect("write"));
        let file = std::io::BufReader::new(std::fs::File::open(&path).expect("file"));
        let mut reader = ::png::Decoder::new(file).read_info().expect("PNG");
        let mut pixels = vec![0; reader.output_buffer_size().expect("size")];
        let info = reader.next_frame(&mut pixels).expect("pixels");
        assert_eq!((info.width, info.height), (400, 18));
        let mut want = Vec::new();
        let drawn: Result<(), std::convert::Infallible> = waterfall.render(|row| {
            want.extend_from_slice(row);
            Ok(())
        });
        assert!(drawn.is_ok() && pixels == want);
        assert_eq!(std::fs::read_dir(dir.path()).expect("dir").count(), 1);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_is_an_error_and_leaves_the_old_picture() {
        let dir = tempfile::tempdir().expect("dir");
        let path = dir.path().join("w.png");
        std::fs::write(&path, "the old picture").expect("write");
        std::os::unix::fs::symlink("/dev/full", dir.path().join("w.png.partial")).expect("link");
        let error = write_waterfall(&path, &waterfall()).expect_err("full disk");
        let text = error.to_string();
        assert!(
            text.contains("w.png") && text.contains("No space left"),
            "{text}"
        );
        assert_eq!(std::fs::read(&path).expect("read"), b"the old picture");
    }

    #[test]
    fn no_pings_no_file_and_no_folder_an_error() {
        let dir = tempfile::tempdir().expect("dir");
        let path = dir.path().join("empty.png");
        let empty = Waterfall::new(WaterfallSpec::default(), 40e3);
        assert!(!write_waterfall(&path, &empty).expect("nothing to do"));
        assert!(!path.exists());
        let error = write_waterfall(Path::new("/no/such/folder/w.png"), &waterfall())
            .expect_err("no folder");
        assert!(
            error.to_string().contains("/no/such/folder/w.png"),
            "{error}"
        );
    }
}
