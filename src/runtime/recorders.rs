//! The files of a replay: `truth.jsonl` always, the rest as asked.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use echotank_protocols::jsf::subsystem;
use echotank_protocols::sevenk::file::{FileDevice, FileHeader7200};

use crate::io::record::npz::NpzRecorder;
use crate::io::record::s7k::S7kRecorder;
use crate::io::record::sigmf::SigmfRecorder;
use crate::io::record::stream::StreamRecorder;
use crate::io::record::truth::TruthRecorder;
use crate::io::record::wav::WavRecorder;
use crate::io::record::{RecordError, make_folder};
use crate::outputs::row_filter;
use crate::pictures::Pictures;
use crate::replay::{Formats, ReplayOptions};
use crate::synthetic_aperture::SyntheticAperture;
use echotank_config::spec::{
    JsfChannels, JsfFormat, JsfSpec, OutputSpec, RigSpec, SevenKSpec, SonarSpec, WavSpec, XtfSpec,
};
use echotank_core::flow::{Datagram, Target};
use echotank_core::time::UtcNs;
use echotank_emit::jsf::{JsfEmitter, JsfSheet, file_time};
use echotank_emit::sevenk::records::DeviceSheet;
use echotank_emit::sevenk::{RecordSet, SevenKEmitter};
use echotank_emit::xtf::XtfEmitter;
use echotank_ping::rig::{PingSlot, Rig};

/// JSF counts channels in 8 bits.
const MAX_JSF_CHANNELS: usize = 256;
/// 7k device identifier of a side-scan of no particular make.
const GENERIC_SIDE_SCAN: u32 = 104;

/// Files of one sonar.
struct SonarFiles {
    spec: SonarSpec,
    folder: PathBuf,
    s7k: Option<S7k>,
    jsf: Option<Jsf>,
    xtf: Option<Xtf>,
    npz: Option<NpzRecorder>,
    pictures: Pictures,
    sas: Option<SyntheticAperture>,
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

/// Begins a `.s7k`: its header and the configuration, stamped with `utc`. Nothing in it comes from the host's clock or a random source, so
/// that the same pings make the same file.
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
    Ok(recorder)
}

/// The start of `text` that fits into `bytes`.
fn text_of(text: &str, bytes: usize) -> String {
    let end = (0..=bytes.min(text.len()))
        .rev()
        .find(|&i| text.is_char_boundary(i))
        .unwrap_or(0);
    text[..end].to_string()
}

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
        let Formats {
            s7k,
            jsf,
            xtf,
            npz,
            sas,
            sigmf,
            wav,
            ..
        } = options.formats;
        let mut sonars = Vec::new();
        for unit in &rig.sonars {
            // One sonar's files lie in the folder itself; several sonars have a folder each.
            let folder = if rig.sonars.len() == 1 {
                options.out.clone()
            } else {
                options.out.join(&unit.spec.name)
            };
            make_folder(&folder)?;
            let sevenk = || {
                let sheet = DeviceSheet::new(
                    &sevenk_output(&unit.spec),
                    &unit.spec,
                    spec.medium.sound_speed_m_per_s,
                    unit.absorption_db_per_m,
                );
                S7k {
                    path: folder.join(format!("{}.s7k", unit.spec.name)),
                    emitter: SevenKEmitter::new(Arc::new(sheet), 1),
                    recorder: None,
                    records: Vec::new(),
                }
            };
            sonars.push(SonarFiles {
                s7k: s7k.then(sevenk),
                jsf: jsf.then(|| {
                    let sheet = JsfSheet {
                        output: jsf_output(&unit.spec),
                        sonar: unit.spec.clone(),
                    };
                    Jsf {
                        path: folder.join(format!("{}.jsf", unit.spec.name)),
                        emitter: JsfEmitter::new(
                            Arc::new(sheet),
                            row_filter(&unit.spec, &spec.medium),
                        ),
                        recorder: None,
                        messages: Vec::new(),
                        last_utc: UtcNs(0),
                    }
                }),
                // A sonar without lines has no XTF.
                xtf: (xtf && !unit.spec.beams.lines.is_empty()).then(|| {
                    let c = spec.medium.sound_speed_m_per_s;
                    Xtf {
                        path: folder.join(format!("{}.xtf", unit.spec.name)),
                        emitter: XtfEmitter::new(&xtf_output(&unit.spec), &unit.spec, c),
                        recorder: None,
                        packets: Vec::new(),
                    }
                }),
                npz: if npz {
                    Some(NpzRecorder::create(&folder, &unit.spec, options.f64)?)
                } else {
                    None
                },
                sas: sas
                    .then(|| SyntheticAperture::new(&unit.spec, spec.medium.sound_speed_m_per_s))
                    .flatten(),
                pictures: Pictures::create(&unit.spec, &folder, options.formats)?,
                sigmf: match sigmf {
                    true => Some(begin_sigmf(&folder, &unit.spec)?),
                    false => None,
                },
                wav: match wav {
                    true => Some(begin_wav(&folder, &unit.spec)?),
                    false => None,
                },
                spec: unit.spec.clone(),
                folder,
            });
        }
        Ok(Self {
            truth: TruthRecorder::create(&options.out)?,
            sonars,
        })
    }

    /// The ping that `rig` has just made.
    pub(crate) fn record(&mut self, slot: &PingSlot, rig: &Rig) -> Result<(), RecordError> {
        let PingSlot { plan, output } = slot;
        let files = &mut self.sonars[plan.sonar];
        self.truth.push(&files.spec, plan, output, rig.targets())?;
        if let Some(s7k) = &mut files.s7k {
            s7k.records.clear();
            let recorder = match &mut s7k.recorder {
                Some(recorder) => recorder,
                none => none.insert(begin_s7k(&s7k.path, s7k.emitter.sheet(), plan.stamp_utc)?),
            };
            s7k.emitter
                .emit_ping(plan, output, RecordSet::ALL, &mut s7k.records);
            for record in &s7k.records {
                recorder.write(&record.bytes)?;
            }
            s7k.records.clear();
        }
        if let Some(jsf) = &mut files.jsf {
            let recorder = match &mut jsf.recorder {
                Some(recorder) => recorder,
                none => {
                    let head = jsf.emitter.sheet().file_head(plan.stamp_utc);
                    none.insert(StreamRecorder::create(&jsf.path, &head)?)
                }
            };
            jsf.last_utc = plan.stamp_utc;
            jsf.emitter
                .emit_ping(plan, output, |_, _| true, &mut jsf.messages);
            for message in jsf.messages.drain(..) {
                recorder.write(&message.bytes)?;
            }
        }
        if let Some(xtf) = &mut files.xtf {
            let recorder = match &mut xtf.recorder {
                Some(recorder) => recorder,
                none => {
                    let head = xtf.emitter.file_head();
                    none.insert(StreamRecorder::create(&xtf.path, &head)?)
                }
            };
            xtf.packets.clear();
            xtf.emitter.emit_ping(plan, output, &mut xtf.packets);
            recorder.write(&xtf.packets)?;
        }
        if let Some(npz) = &mut files.npz {
            npz.push(plan, output)?;
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
        files.pictures.push(slot, rig)
    }

    /// Closes every file and names those that hold something.
    pub(crate) fn finish(self, targets: &[Target]) -> Result<Vec<PathBuf>, RecordError> {
        let mut written = vec![self.truth.path().to_path_buf()];
        for files in self.sonars {
            if let Some(S7k {
                path,
                recorder: Some(recorder),
                ..
            }) = files.s7k
            {
                recorder.close()?;
                written.push(path);
            }
            if let Some(Jsf {
                path,
                recorder: Some(recorder),
                last_utc,
                ..
            }) = files.jsf
            {
                recorder.close(&file_time(last_utc))?;
                written.push(path);
            }
            if let Some(Xtf {
                path,
                recorder: Some(recorder),
                ..
            }) = files.xtf
            {
                recorder.close(&[])?;
                written.push(path);
            }
            if let Some(npz) = files.npz {
                written.extend(npz.finish()?);
            }
            if let Some(sigmf) = files.sigmf {
                written.extend(sigmf.paths().map(Path::to_path_buf));
                sigmf.close()?;
            }
            if let Some(wav) = files.wav {
                written.push(wav.path().to_path_buf());
                wav.close()?;
            }
            if let Some(patch) = files.sas.and_then(SyntheticAperture::finish) {
                written.extend(patch.write(&files.folder)?);
            }
            written.extend(files.pictures.finish(targets)?);
        }
        Ok(written)
    }
}

/// The 7k output whose device and arrays the file speaks for; a sonar without one gets all its arrays on a generic side-scan.
fn sevenk_output(spec: &SonarSpec) -> SevenKSpec {
    let configured = spec.outputs.iter().find_map(|output| match output {
        OutputSpec::SevenK(sevenk) => Some(sevenk),
        _ => None,
    });
    configured.cloned().unwrap_or_else(|| SevenKSpec {
        listen: (std::net::Ipv4Addr::LOCALHOST, 0).into(),
        device_id: GENERIC_SIDE_SCAN,
        enumerator: 0,
        arrays: (0..spec.receive.len()).collect(),
        max_packet: 0,
        client_queue_bytes: 0,
        disconnect_when_full: false,
        max_clients: 0,
    })
}

/// The JSF output whose format the file has; a sonar without one gets its sides as envelopes, or where it has none its elements.
fn jsf_output(spec: &SonarSpec) -> JsfSpec {
    let configured = spec.outputs.iter().find_map(|output| match output {
        OutputSpec::Jsf(jsf) => Some(jsf),
        _ => None,
    });
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

/// As many arrays as JSF has channels for.
fn first_channels(spec: &SonarSpec) -> Vec<usize> {
    let mut elements = 0;
    let arrays = spec.receive.iter().take_while(|array| {
        elements += array.elements;
        elements <= MAX_JSF_CHANNELS
    });
    (0..arrays.count()).collect()
}

fn xtf_output(spec: &SonarSpec) -> XtfSpec {
    let configured = spec.outputs.iter().find_map(|output| match output {
        OutputSpec::Xtf(xtf) => Some(*xtf),
        _ => None,
    });
    configured.unwrap_or(XtfSpec { is_float: false })
}

/// The arrays of the configured output, or all.
fn begin_sigmf(folder: &Path, spec: &SonarSpec) -> Result<SigmfRecorder, RecordError> {
    let configured = spec.outputs.iter().find_map(|output| match output {
        OutputSpec::Sigmf(sigmf) => Some(sigmf.arrays.clone()),
        _ => None,
    });
    let arrays = configured.unwrap_or_else(|| (0..spec.receive.len()).collect());
    SigmfRecorder::create(&folder.join(&spec.name), &arrays, spec)
}

/// The arrays and the rate of the configured output, or all and the usual rate.
fn begin_wav(folder: &Path, spec: &SonarSpec) -> Result<WavRecorder, RecordError> {
    let configured = spec.outputs.iter().find_map(|output| match output {
        OutputSpec::Wav(wav) => Some(wav.clone()),
        _ => None,
    });
    let output = configured.unwrap_or_else(|| WavSpec {
        arrays: (0..spec.receive.len()).collect(),
        rate_hz: WavSpec::usual_rate_hz(
            spec.pulse.center_frequency_hz + 0.5 * spec.pulse.bandwidth_hz,
        ),
        is_float: false,
    });
    let path = folder.join(format!("{}.wav", spec.name));
    WavRecorder::create(&path, &output, spec)
}
