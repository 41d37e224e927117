//! Files of a replay: always `truth.jsonl`, and the requested formats.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use echotank_protocols::jsf::subsystem;
use echotank_protocols::sevenk::file::{FileDevice, FileHeader7200};

use crate::formats::ReplayOptions;
use crate::io::record::mcap::McapRecorder;
use crate::io::record::npz::NpzRecorder;
use crate::io::record::s7k::S7kRecorder;
use crate::io::record::sigmf::SigmfRecorder;
use crate::io::record::stream::StreamRecorder;
use crate::io::record::truth::TruthRecorder;
use crate::io::record::wav::WavRecorder;
use crate::io::record::zarr::ZarrRecorder;
use crate::io::record::{RecordError, make_folder};
use crate::outputs::row_filter;
use crate::pictures::Pictures;
use crate::synthetic_aperture::SyntheticAperture;
use echotank_config::spec::{
    JsfChannels, JsfFormat, JsfSpec, McapSpec, MediumSpec, OutputSpec, RigSpec, SevenKSpec,
    SonarSpec, WavSpec, XtfSpec,
};
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::records::Datagram;
use echotank_core::scene::Target;
use echotank_core::time::UtcNs;
use echotank_emit::jsf::{JsfEmitter, JsfSheet, file_time};
use echotank_emit::sevenk::SevenKEmitter;
use echotank_emit::sevenk::records::DeviceSheet;
use echotank_emit::xtf::XtfEmitter;
use echotank_ping::rig::{PingSlot, Rig, SonarUnit};

/// JSF channel numbers have 8 bits.
const MAX_JSF_CHANNELS: usize = 256;
/// 7k device identifier of a generic side-scan.
const GENERIC_SIDE_SCAN: u32 = 104;

/// Files of one sonar.
struct SonarFiles {
    spec: SonarSpec,
    folder: PathBuf,
    s7k: Option<S7k>,
    jsf: Option<Jsf>,
    xtf: Option<Xtf>,
    npz: Option<NpzRecorder>,
    zarr: Option<ZarrRecorder>,
    pictures: Pictures,
    sas: Option<SyntheticAperture>,
    mcap: Option<McapRecorder>,
    sigmf: Option<SigmfRecorder>,
    wav: Option<WavRecorder>,
}

struct S7k {
    path: PathBuf,
    emitter: SevenKEmitter,
    recorder: Option<S7kRecorder>,
    records: Vec<Arc<Datagram>>,
}

struct Jsf {
    path: PathBuf,
    emitter: JsfEmitter,
    recorder: Option<StreamRecorder>,
    messages: Vec<Arc<Datagram>>,
    last_utc: UtcNs,
}

struct Xtf {
    path: PathBuf,
    emitter: XtfEmitter,
    recorder: Option<StreamRecorder>,
    packets: Vec<u8>,
}

/// Creates a `.s7k` file with its header and configuration record at the time `utc`.
///
/// The contents depend on neither the host's clock nor a random source, so equal pings give an equal file.
pub(crate) fn begin_s7k(
    path: &Path,
    sheet: &DeviceSheet,
    utc: UtcNs,
) -> Result<S7kRecorder, RecordError> {
    let stamp = sheet.stamp(utc);
    let header = FileHeader7200 {
        file_id: [sheet.sonar_id(), utc.0 as u64],
        session_id: [sheet.sonar_id(), utc.0 as u64],
        recording_name: text_of(
            path.file_stem()
                .map(|name| name.to_string_lossy())
                .unwrap_or_default()
                .as_ref(),
            63,
        ),
        program_version: text_of(concat!("echotank ", env!("CARGO_PKG_VERSION")), 15),
        user_defined_name: text_of(sheet.name(), 63),
        notes: "Simulated by Echotank".into(),
        devices: vec![FileDevice {
            device_id: stamp.device_id,
            system_enumerator: stamp.system_enumerator,
        }],
    };
    let mut recorder = S7kRecorder::create(path, header, stamp)?;
    recorder.write(&sheet.configuration_7001(utc).bytes)?;
    for record in sheet.descriptions(utc) {
        recorder.write(&record.bytes)?;
    }
    Ok(recorder)
}

/// Longest prefix of `text` that fits into `bytes` bytes of UTF-8.
fn text_of(text: &str, bytes: usize) -> String {
    let end = (0..=bytes.min(text.len()))
        .rev()
        .find(|&i| text.is_char_boundary(i))
        .unwrap_or(0);
    text[..end].to_string()
}

impl S7k {
    fn new(folder: &Path, unit: &SonarUnit, rig: &RigSpec) -> Self {
        let sonar = &unit.spec;
        let sheet = DeviceSheet::new(
            &sevenk_output(sonar),
            sonar,
            rig.medium.sound_speed_m_per_s,
            unit.absorption_db_per_m,
        )
        .with_navigation(&rig.nav)
        .with_profile(rig.medium.profile.as_ref());
        Self {
            path: folder.join(format!("{}.s7k", sonar.name)),
            emitter: SevenKEmitter::new(Arc::new(sheet), 1),
            recorder: None,
            records: Vec::new(),
        }
    }

    fn push(&mut self, plan: &PingPlan, output: &PingOutput) -> Result<(), RecordError> {
        self.records.clear();
        let recorder = match &mut self.recorder {
            Some(recorder) => recorder,
            none => none.insert(begin_s7k(&self.path, self.emitter.sheet(), plan.stamp_utc)?),
        };
        let wanted = self.emitter.sheet().file_records();
        self.emitter
            .emit_ping(plan, output, wanted, &mut self.records);
        for record in self.records.drain(..) {
            recorder.write(&record.bytes)?;
        }
        Ok(())
    }
}

impl Jsf {
    fn new(folder: &Path, sonar: &SonarSpec, medium: &MediumSpec) -> Self {
        let sheet = JsfSheet {
            output: jsf_output(sonar),
            sonar: sonar.clone(),
        };
        Self {
            path: folder.join(format!("{}.jsf", sonar.name)),
            emitter: JsfEmitter::new(Arc::new(sheet), row_filter(sonar, medium)),
            recorder: None,
            messages: Vec::new(),
            last_utc: UtcNs(0),
        }
    }

    fn push(&mut self, plan: &PingPlan, output: &PingOutput) -> Result<(), RecordError> {
        let recorder = match &mut self.recorder {
            Some(recorder) => recorder,
            none => {
                let head = self.emitter.sheet().file_head(plan.stamp_utc);
                none.insert(StreamRecorder::create(&self.path, &head)?)
            }
        };
        self.last_utc = plan.stamp_utc;
        self.emitter
            .emit_ping(plan, output, |_, _| true, &mut self.messages);
        for message in self.messages.drain(..) {
            recorder.write(&message.bytes)?;
        }
        Ok(())
    }
}

impl Xtf {
    fn new(folder: &Path, sonar: &SonarSpec, medium: &MediumSpec) -> Self {
        let c = medium.sound_speed_m_per_s;
        Self {
            path: folder.join(format!("{}.xtf", sonar.name)),
            emitter: XtfEmitter::new(&xtf_output(sonar), sonar, c),
            recorder: None,
            packets: Vec::new(),
        }
    }

    fn push(&mut self, plan: &PingPlan, output: &PingOutput) -> Result<(), RecordError> {
        let recorder = match &mut self.recorder {
            Some(recorder) => recorder,
            none => {
                let head = self.emitter.file_head();
                none.insert(StreamRecorder::create(&self.path, &head)?)
            }
        };
        self.packets.clear();
        self.emitter.emit_ping(plan, output, &mut self.packets);
        recorder.write(&self.packets)
    }
}

impl SonarFiles {
    fn create(
        unit: &SonarUnit,
        rig: &RigSpec,
        folder: PathBuf,
        options: &ReplayOptions,
    ) -> Result<Self, RecordError> {
        make_folder(&folder)?;
        let (sonar, medium) = (&unit.spec, &rig.medium);
        let formats = options.formats;
        // XTF holds side-scan lines only.
        let has_xtf = formats.xtf && !sonar.beams.lines.is_empty();
        Ok(Self {
            s7k: formats.s7k.then(|| S7k::new(&folder, unit, rig)),
            jsf: formats.jsf.then(|| Jsf::new(&folder, sonar, medium)),
            xtf: has_xtf.then(|| Xtf::new(&folder, sonar, medium)),
            npz: match formats.npz {
                true => Some(NpzRecorder::create(&folder, sonar, options.f64)?),
                false => None,
            },
            zarr: match formats.zarr {
                true => Some(ZarrRecorder::create(&folder, sonar, options.f64)?),
                false => None,
            },
            sas: match formats.sas {
                true => SyntheticAperture::new(sonar, medium.sound_speed_m_per_s),
                false => None,
            },
            pictures: Pictures::create(sonar, &folder, formats)?,
            mcap: match formats.mcap {
                true => Some(begin_mcap(&folder, sonar)?),
                false => None,
            },
            sigmf: match formats.sigmf {
                true => Some(begin_sigmf(&folder, sonar)?),
                false => None,
            },
            wav: match formats.wav {
                true => Some(begin_wav(&folder, sonar)?),
                false => None,
            },
            spec: sonar.clone(),
            folder,
        })
    }

    /// Closes the files and adds the paths of files with contents to `written`.
    fn finish(self, targets: &[Target], written: &mut Vec<PathBuf>) -> Result<(), RecordError> {
        if let Some(S7k {
            path,
            recorder: Some(recorder),
            ..
        }) = self.s7k
        {
            recorder.close()?;
            written.push(path);
        }
        if let Some(Jsf {
            path,
            recorder: Some(recorder),
            last_utc,
            ..
        }) = self.jsf
        {
            recorder.close(&file_time(last_utc))?;
            written.push(path);
        }
        if let Some(Xtf {
            path,
            recorder: Some(recorder),
            ..
        }) = self.xtf
        {
            recorder.close(&[])?;
            written.push(path);
        }
        if let Some(npz) = self.npz {
            written.extend(npz.finish()?);
        }
        if let Some(zarr) = self.zarr {
            written.extend(zarr.finish()?);
        }
        if let Some(mcap) = self.mcap {
            written.push(mcap.path().to_path_buf());
            mcap.close()?;
        }
        if let Some(sigmf) = self.sigmf {
            written.extend(sigmf.paths().map(Path::to_path_buf));
            sigmf.close()?;
        }
        if let Some(wav) = self.wav {
            written.push(wav.path().to_path_buf());
            wav.close()?;
        }
        if let Some(patch) = self.sas.and_then(SyntheticAperture::finish) {
            written.extend(patch.write(&self.folder)?);
        }
        written.extend(self.pictures.finish(targets)?);
        Ok(())
    }
}

/// All files of a replay.
pub(crate) struct Recorders {
    truth: TruthRecorder,
    sonars: Vec<SonarFiles>,
}

impl Recorders {
    pub(crate) fn create(
        spec: &RigSpec,
        options: &ReplayOptions,
        rig: &Rig,
    ) -> Result<Self, RecordError> {
        let mut sonars = Vec::new();
        for unit in &rig.sonars {
            // If there are several sonars, each has a folder.
            let folder = match rig.sonars.len() {
                1 => options.out.clone(),
                _ => options.out.join(&unit.spec.name),
            };
            sonars.push(SonarFiles::create(unit, spec, folder, options)?);
        }
        Ok(Self {
            truth: TruthRecorder::create(&options.out)?,
            sonars,
        })
    }

    /// Writes the ping in `slot`, which `rig` has just computed.
    pub(crate) fn record(&mut self, slot: &PingSlot, rig: &Rig) -> Result<(), RecordError> {
        let PingSlot { plan, output } = slot;
        let files = &mut self.sonars[plan.sonar];
        self.truth.push(&files.spec, plan, output, rig.targets())?;
        if let Some(s7k) = &mut files.s7k {
            s7k.push(plan, output)?;
        }
        if let Some(jsf) = &mut files.jsf {
            jsf.push(plan, output)?;
        }
        if let Some(xtf) = &mut files.xtf {
            xtf.push(plan, output)?;
        }
        if let Some(npz) = &mut files.npz {
            npz.push(plan, output)?;
        }
        if let Some(mcap) = &mut files.mcap {
            mcap.push(plan, output)?;
        }
        if let Some(sigmf) = &mut files.sigmf {
            sigmf.push(plan, output)?;
        }
        if let Some(wav) = &mut files.wav {
            wav.push(plan, output)?;
        }
        if let Some(sas) = &mut files.sas {
            sas.push(&files.spec, plan, output);
        }
        let (lines, beams) = files.pictures.push(slot, rig)?;
        if let Some(zarr) = &mut files.zarr {
            zarr.push(plan, output, (&lines, &beams))?;
        }
        Ok(())
    }

    /// Closes every file and returns the paths of files with contents.
    pub(crate) fn finish(self, targets: &[Target]) -> Result<Vec<PathBuf>, RecordError> {
        let mut written = vec![self.truth.path().to_path_buf()];
        for files in self.sonars {
            files.finish(targets, &mut written)?;
        }
        Ok(written)
    }
}

/// First configured output of a kind.
macro_rules! configured {
    ($spec:expr, $kind:ident) => {
        $spec.outputs.iter().find_map(|output| match output {
            OutputSpec::$kind(output) => Some(output),
            _ => None,
        })
    };
}

/// Configured 7k output. The default is a generic side-scan with all arrays.
fn sevenk_output(spec: &SonarSpec) -> SevenKSpec {
    let configured = configured!(spec, SevenK);
    configured.cloned().unwrap_or_else(|| SevenKSpec {
        has_common_files: false,
        listen: (std::net::Ipv4Addr::LOCALHOST, 0).into(),
        device_id: GENERIC_SIDE_SCAN,
        enumerator: 0,
        arrays: (0..spec.receive.len()).collect(),
        max_packet: 0,
        client_queue_bytes: 0,
        disconnect_when_full: false,
        third_parties: Vec::new(),
        max_clients: 0,
    })
}

/// Configured JSF output. The default has the side-scan lines as envelopes, or the elements if the sonar has no side-scan lines.
fn jsf_output(spec: &SonarSpec) -> JsfSpec {
    let configured = configured!(spec, Jsf);
    let has_lines = !spec.beams.lines.is_empty();
    configured.cloned().unwrap_or_else(|| JsfSpec {
        listen: (std::net::Ipv4Addr::LOCALHOST, 0).into(),
        listen_data: (std::net::Ipv4Addr::LOCALHOST, 0).into(),
        subsystem: if has_lines {
            subsystem::SIDE_SCAN_LOW
        } else {
            subsystem::BATHYMETRY_LOW
        },
        silent_subsystems: Vec::new(),
        channels: if has_lines {
            JsfChannels::Sides
        } else {
            JsfChannels::Staves
        },
        arrays: first_channels(spec),
        format: if has_lines {
            JsfFormat::Envelope
        } else {
            JsfFormat::Unfiltered
        },
        record: true,
        client_queue_bytes: 0,
        max_clients: 0,
    })
}

/// Indices of the first arrays whose elements fit into the JSF channels.
fn first_channels(spec: &SonarSpec) -> Vec<usize> {
    let mut elements = 0;
    let arrays = spec.receive.iter().take_while(|array| {
        elements += array.elements;
        elements <= MAX_JSF_CHANNELS
    });
    (0..arrays.count()).collect()
}

fn xtf_output(spec: &SonarSpec) -> XtfSpec {
    let configured = configured!(spec, Xtf);
    configured.copied().unwrap_or(XtfSpec { is_float: false })
}

/// Starts an MCAP recording with the messages of the configured output, or with all messages.
fn begin_mcap(folder: &Path, spec: &SonarSpec) -> Result<McapRecorder, RecordError> {
    let output = configured!(spec, Mcap).copied();
    let path = folder.join(format!("{}.mcap", spec.name));
    McapRecorder::create(&path, &output.unwrap_or(McapSpec::ALL), spec)
}

/// Starts a SigMF recording with the arrays of the configured output, or with all arrays.
fn begin_sigmf(folder: &Path, spec: &SonarSpec) -> Result<SigmfRecorder, RecordError> {
    let configured = configured!(spec, Sigmf).map(|sigmf| sigmf.arrays.clone());
    let arrays = configured.unwrap_or_else(|| (0..spec.receive.len()).collect());
    SigmfRecorder::create(&folder.join(&spec.name), &arrays, spec)
}

/// Starts a WAV recording with the arrays and rate of the configured output, or with all arrays at the default rate.
fn begin_wav(folder: &Path, spec: &SonarSpec) -> Result<WavRecorder, RecordError> {
    let configured = configured!(spec, Wav);
    let output = configured.cloned().unwrap_or_else(|| WavSpec {
        arrays: (0..spec.receive.len()).collect(),
        rate_hz: WavSpec::usual_rate_hz(
            spec.pulse.center_frequency_hz + 0.5 * spec.pulse.bandwidth_hz,
        ),
        is_float: false,
    });
    let path = folder.join(format!("{}.wav", spec.name));
    WavRecorder::create(&path, &output, spec)
}
