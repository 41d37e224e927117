//! Joins `.npz` files of successive pings to the file that one recorder would have written of all of them, byte for byte.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use zip::ZipArchive;

use super::npz::Archive;
use super::{PartialFile, RecordError};

/// Members with one row for each ping. All others belong to the sonar or to the first ping.
const PER_PING: [&str; 19] = [
    "iq_by_element",
    "beams",
    "lines",
    "more_lines",
    "ping_number",
    "ping_utc_ns",
    "transmit_position_m",
    "element_position_m",
    "velocity_m_per_s",
    "position_m",
    "attitude_deg",
    "geodetic_deg",
    "line_position_m",
    "sounding_twtt_s",
    "sounding_error_s",
    "sounding_method",
    "target",
    "shadow",
    "depth_m",
];
/// Longest header of a member, bytes.
const MAX_HEADER_BYTES: usize = 65_535;
/// Bytes copied at a time.
const BLOCK: usize = 1 << 18;

/// Type, shape and beginning of the data of a member.
struct Member<R> {
    descr: String,
    shape: Vec<usize>,
    data: R,
}

/// Joins `parts`, which hold successive pings of one sonar, into `target`.
///
/// # Errors
/// A part cannot be read, or its arrays do not fit those of the first; the target cannot be written.
pub(crate) fn join(parts: &[&Path], target: &Path) -> Result<(), RecordError> {
    let mut archives = Vec::new();
    for part in parts {
        let file = File::open(part).map_err(RecordError::io(part, "open"))?;
        let archive = ZipArchive::new(BufReader::with_capacity(BLOCK, file));
        archives.push((*part, archive.map_err(|e| unfit(part, e))?));
    }
    let Some((_, first)) = archives.first_mut() else {
        return Ok(());
    };
    let mut names = Vec::new();
    for index in 0..first.len() {
        let member = first.by_index(index).map_err(|e| unfit(parts[0], e))?;
        let name = member.name().map_err(|e| unfit(parts[0], e))?;
        names.push(name.trim_end_matches(".npy").to_owned());
    }
    let pings: Vec<usize> = archives
        .iter_mut()
        .map(|(part, archive)| {
            open(part, archive, "ping_number").map(|m| m.shape.first().copied().unwrap_or(0))
        })
        .collect::<Result<_, _>>()?;
    let mut joined = Archive::create(target)?;
    for name in &names {
        if name == "beam_angle_rad" {
            join_angles(&mut archives, &pings, target, &mut joined)?;
        } else if PER_PING.contains(&name.as_str()) {
            join_rows(&mut archives, name, target, &mut joined)?;
        } else {
            let (part, archive) = &mut archives[0];
            let mut member = open(part, archive, name)?;
            let mut data = Vec::new();
            let read = member.data.read_to_end(&mut data);
            read.map_err(RecordError::io(part, "read"))?;
            joined.small(name, &member.descr, &member.shape, &data)?;
        }
    }
    joined.finish()
}

type Part<'a> = (&'a Path, ZipArchive<BufReader<File>>);

fn unfit(part: &Path, why: impl std::fmt::Display) -> RecordError {
    RecordError::io(part, "read")(std::io::Error::other(why.to_string()))
}

fn open<'a>(
    part: &Path,
    archive: &'a mut ZipArchive<BufReader<File>>,
    name: &str,
) -> Result<Member<impl Read + use<'a>>, RecordError> {
    let mut data = archive
        .by_name(&format!("{name}.npy"))
        .map_err(|e| unfit(part, format!("{name}: {e}")))?;
    let mut prefix = [0; 10];
    data.read_exact(&mut prefix)
        .map_err(RecordError::io(part, "read"))?;
    let length = usize::from(u16::from_le_bytes([prefix[8], prefix[9]]));
    if prefix[..8] != *b"\x93NUMPY\x01\x00" || length > MAX_HEADER_BYTES {
        return Err(unfit(
            part,
            format!("{name}: is not an array of this program"),
        ));
    }
    let mut header = vec![0; length];
    data.read_exact(&mut header)
        .map_err(RecordError::io(part, "read"))?;
    let header = String::from_utf8_lossy(&header);
    let after = |key: &str| header.split_once(key).map(|(_, rest)| rest);
    let descr = after("'descr': '").and_then(|rest| rest.split('\'').next());
    let shape = after("'shape': (").and_then(|rest| rest.split(')').next());
    let numbers = shape.map(|shape| {
        let parts = shape.split(',').map(str::trim).filter(|n| !n.is_empty());
        parts.map(str::parse).collect::<Result<Vec<usize>, _>>()
    });
    match (descr, numbers) {
        (Some(descr), Some(Ok(shape))) => Ok(Member {
            descr: descr.to_owned(),
            shape,
            data,
        }),
        _ => Err(unfit(
            part,
            format!("{name}: has a header of another program"),
        )),
    }
}

/// The rows of all parts, one after another.
fn join_rows(
    archives: &mut [Part],
    name: &str,
    target: &Path,
    joined: &mut Archive,
) -> Result<(), RecordError> {
    let mut rows = PartialFile::create(&target.with_extension(format!("npz.{name}")))?;
    let mut whole: Option<(String, Vec<usize>)> = None;
    let mut block = vec![0; BLOCK];
    for (part, archive) in archives {
        let mut member = open(part, archive, name)?;
        match &mut whole {
            None => whole = Some((member.descr, member.shape)),
            Some((descr, shape))
                if *descr == member.descr && shape.get(1..) == member.shape.get(1..) =>
            {
                shape[0] += member.shape[0];
            }
            Some((descr, shape)) => {
                let (got, want) = ((&member.descr, &member.shape), (descr, shape));
                return Err(unfit(
                    part,
                    format!("{name}: is {got:?}, the parts before are {want:?}"),
                ));
            }
        }
        loop {
            match member.data.read(&mut block) {
                Ok(0) => break,
                Ok(n) => rows.write(&block[..n])?,
                Err(why) => return Err(RecordError::io(part, "read")(why)),
            }
        }
    }
    match whole {
        Some((descr, shape)) => joined.streamed(name, &descr, &shape, rows),
        None => Ok(()),
    }
}

/// The angles of the beams: those of the first ping if no ping has others, else a row for each ping.
fn join_angles(
    archives: &mut [Part],
    pings: &[usize],
    target: &Path,
    joined: &mut Archive,
) -> Result<(), RecordError> {
    const NAME: &str = "beam_angle_rad";
    let mut all: Vec<(Vec<usize>, Vec<u8>)> = Vec::new();
    for (part, archive) in &mut *archives {
        let mut member = open(part, archive, NAME)?;
        let mut data = Vec::new();
        let read = member.data.read_to_end(&mut data);
        read.map_err(RecordError::io(part, "read"))?;
        all.push((member.shape, data));
    }
    let is_constant = all.iter().all(|part| part.0.len() == 1 && *part == all[0]);
    if is_constant {
        return joined.small(NAME, "<f8", &all[0].0, &all[0].1);
    }
    let mut rows = PartialFile::create(&target.with_extension(format!("npz.{NAME}")))?;
    for ((shape, data), &pings) in all.iter().zip(pings) {
        let repeats = if shape.len() == 1 { pings } else { 1 };
        for _ in 0..repeats {
            rows.write(data)?;
        }
    }
    let beams = all[0].0.last().copied().unwrap_or(0);
    let shape = [pings.iter().sum(), beams];
    joined.streamed(NAME, "<f8", &shape, rows)
}
