//! `echotank new`: writes a rig for a kind of sonar, a frequency, a range and a protocol, with the ping rate that its estimated cost on two cores allows.

mod design;
mod text;
mod track;

use std::fs::OpenOptions;
use std::io::{BufRead, IsTerminal, Write};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use self::design::{Design, FREQUENCIES_KHZ, Kind, Protocol, digits, word, words};
use self::text::Pace;
use super::Failure;
use echotank_config::Files;
use echotank_config::spec::{NavInputSpec, RigSpec, SeabedFileSpec};
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::threads::pool;
use echotank_runtime::config_files::{self, read_bounded};
use echotank_runtime::first_pings::first;
use echotank_runtime::io::files::FileSystem;
use echotank_runtime::io::nav::MAX_LOG_BYTES;
use echotank_scene::read::survey::Survey;

/// Cores for which a rig is sized.
const CORES: usize = 2;
/// Ping period relative to the estimated time of a ping; `check` calls less than 1.25 too slow.
const MARGIN: f64 = 1.5;
const EXAMPLE: &str = "echotank new sidescan --frequency-khz 455 --range-m 75 --protocol jsf";

#[derive(Args, Clone, Debug, Default)]
pub(crate) struct NewArgs {
    /// Kind of sonar; asked for on a terminal, as the other parts
    #[arg(value_enum)]
    pub(crate) kind: Option<Kind>,
    /// Centre frequency, kHz
    #[arg(long, value_name = "F", allow_negative_numbers = true)]
    pub(crate) frequency_khz: Option<f64>,
    /// Range, metres
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    pub(crate) range_m: Option<f64>,
    /// Protocols that the rig serves, separated by commas
    #[arg(long, value_enum, value_delimiter = ',')]
    pub(crate) protocol: Vec<Protocol>,
    /// Elements of an array (default: 4 a side, 96 of a multibeam, 64 ahead, 8 of a board)
    #[arg(long, value_name = "N")]
    pub(crate) elements: Option<usize>,
    /// Navigation: udp:PORT, udp://HOST:PORT, tcp://HOST:PORT, serial:DEVICE:BAUD, or the file of a log or track (default: an invented track beside the rig)
    #[arg(long, value_name = "ADDRESS|FILE")]
    pub(crate) nav: Option<String>,
    /// Survey of the seabed, in any format of `scene info` (default: flat sand)
    #[arg(long, value_name = "FILE")]
    pub(crate) seabed: Option<PathBuf>,
    /// File to write (default: the kind of sonar, in this folder)
    #[arg(long, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Replace an existing file
    #[arg(long)]
    pub(crate) force: bool,
}

/// Navigation of the rig.
enum Nav {
    Invented,
    Track(PathBuf),
    Log(PathBuf),
    Udp(SocketAddr),
    Tcp(String),
    Serial(String, u32),
}

impl Nav {
    fn is_live(&self) -> bool {
        matches!(self, Self::Udp(_) | Self::Tcp(_) | Self::Serial(..))
    }
}

struct Seabed {
    path: PathBuf,
    depth_m: f64,
}

/// The checked parts of a rig.
struct Request {
    protocols: Vec<Protocol>,
    nav: Nav,
    seabed: Option<Seabed>,
    draft_m: f64,
    out: PathBuf,
    /// Folder of `out`, from the root of the file system.
    folder: PathBuf,
}

impl Request {
    /// Name of the invented track, which lies beside the rig.
    fn track_name(&self) -> String {
        let stem = self.out.file_stem().unwrap_or_default();
        format!("{}-track.csv", stem.to_string_lossy())
    }
}

pub(crate) fn main(args: &NewArgs) -> Result<(), Failure> {
    let mut args = args.clone();
    if std::io::stdin().is_terminal() {
        ask(
            &mut args,
            &mut std::io::stdin().lock(),
            &mut std::io::stderr(),
        )?;
    }
    let (request, design) = checked(&args)?;
    let track = request.out.with_file_name(request.track_name());
    let mut files = vec![request.out.clone()];
    if let Nav::Invented = request.nav {
        files.push(track);
    }
    if let Some(there) = files.iter().find(|file| file.exists() && !args.force) {
        return Err(refusal(
            "--out",
            there.display(),
            "exists already: give another file, or --force to replace it",
        ));
    }
    let (text, pace) = sized(&request, &design)?;
    let texts = [text, track::text()];
    for (file, text) in files.iter().zip(texts) {
        write(file, &text, args.force).map_err(|why| {
            refusal(
                "--out",
                file.display(),
                &format!("cannot be written: {why}"),
            )
        })?;
        println!("wrote        {}", file.display());
    }
    let name = request.out.display();
    println!(
        "rate         {} pings/s; a ping takes an estimated {:.0} ms on two cores",
        pace.rate_hz,
        1e3 * pace.compute_s
    );
    println!("next         echotank check {name}; echotank run {name}");
    Ok(())
}

fn write(file: &Path, text: &str, force: bool) -> std::io::Result<()> {
    let mut options = OpenOptions::new();
    options.write(true).truncate(true);
    match force {
        true => options.create(true),
        false => options.create_new(true),
    };
    options.open(file)?.write_all(text.as_bytes())
}

fn refusal(argument: &str, value: impl std::fmt::Display, rule: &str) -> Failure {
    Failure::Configuration(format!("echotank new: {argument} {value}: {rule}"))
}

// ---------------------------------------------------------------- arguments

fn checked(args: &NewArgs) -> Result<(Request, Design), Failure> {
    let missing = |argument: &str| {
        Failure::Configuration(format!(
            "echotank new: {argument} is missing, for example: {EXAMPLE}"
        ))
    };
    let kind = args.kind.ok_or_else(|| {
        let kinds = words(Kind::value_variants());
        missing(&format!("the kind of sonar ({kinds})"))
    })?;
    let frequency_khz = args
        .frequency_khz
        .ok_or_else(|| missing("--frequency-khz"))?;
    let range_m = args.range_m.ok_or_else(|| missing("--range-m"))?;
    if args.protocol.is_empty() {
        return Err(missing(&format!(
            "--protocol ({})",
            words(kind.protocols())
        )));
    }
    let frequency_khz = frequency(frequency_khz)?;
    let protocols = protocols(kind, &args.protocol)?;
    let elements = elements(kind, args.elements)?;
    let range_m = range(kind, frequency_khz, elements, range_m)?;
    let design = Design::new(kind, 1e3 * frequency_khz, range_m, elements);
    let out = args
        .out
        .clone()
        .unwrap_or_else(|| PathBuf::from(format!("{}.toml", word(&kind))));
    let folder = match out.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    let folder = folder.canonicalize().map_err(|why| {
        refusal(
            "--out",
            out.display(),
            &format!("its folder cannot be used: {why}"),
        )
    })?;
    let seabed = args.seabed.as_deref();
    let seabed = seabed
        .map(|path| self::seabed(path, range_m, &folder))
        .transpose()?;
    let depth_m = seabed
        .as_ref()
        .map_or(design.depth_m, |seabed| seabed.depth_m);
    let request = Request {
        protocols,
        nav: args
            .nav
            .as_deref()
            .map_or(Ok(Nav::Invented), |text| nav(text, &folder))?,
        draft_m: Design::draft_m(depth_m),
        seabed,
        folder,
        out,
    };
    Ok((request, design))
}

fn frequency(khz: f64) -> Result<f64, Failure> {
    let [lowest, highest] = FREQUENCIES_KHZ;
    match (lowest..=highest).contains(&khz) {
        true => Ok(khz),
        false => Err(refusal(
            "--frequency-khz",
            khz,
            &format!("must be {lowest} to {highest} kHz"),
        )),
    }
}

fn range(kind: Kind, frequency_khz: f64, elements: usize, range_m: f64) -> Result<f64, Failure> {
    let [shortest_m, longest_m] = Design::ranges_m(kind, 1e3 * frequency_khz, elements);
    match (shortest_m..=longest_m).contains(&range_m) {
        true => Ok(range_m),
        false => Err(refusal(
            "--range-m",
            range_m,
            &format!(
                "must be {shortest_m} to {longest_m} m at {frequency_khz} kHz: nearer, the arrays are too long; farther, echoes lie below the noise"
            ),
        )),
    }
}

fn elements(kind: Kind, asked: Option<usize>) -> Result<usize, Failure> {
    let [fewest, usual, most] = kind.elements();
    let elements = asked.unwrap_or(usual);
    match (fewest..=most).contains(&elements) {
        true => Ok(elements),
        false => {
            let rule = format!("must be {fewest} to {most} for a {}", kind.noun());
            Err(refusal("--elements", elements, &rule))
        }
    }
}

fn protocols(kind: Kind, asked: &[Protocol]) -> Result<Vec<Protocol>, Failure> {
    let mut protocols: Vec<Protocol> = Vec::new();
    for protocol in asked {
        if !kind.protocols().contains(protocol) {
            let rule = format!(
                "does not suit a {}: one of {}",
                kind.noun(),
                words(kind.protocols())
            );
            return Err(refusal("--protocol", word(protocol), &rule));
        }
        if !protocols.contains(protocol) {
            protocols.push(*protocol);
        }
    }
    if kind == Kind::Sidescan && protocols.contains(&Protocol::Ping) && protocols.len() > 1 {
        let rule =
            "`ping` must be the only protocol of a side-scan: each side is a device of its own";
        return Err(refusal("--protocol", words(&protocols), rule));
    }
    Ok(protocols)
}

/// The path as the rig in `folder` names it: relative if it lies within the folder.
fn beside(path: &Path, folder: &Path) -> std::io::Result<PathBuf> {
    let whole = path.canonicalize()?;
    Ok(whole
        .strip_prefix(folder)
        .map_or_else(|_| whole.clone(), Path::to_path_buf))
}

fn nav(text: &str, folder: &Path) -> Result<Nav, Failure> {
    let refuse = |rule: &str| refusal("--nav", text, rule);
    let address = |rest: &'_ str| rest.strip_prefix("//").unwrap_or(rest).to_owned();
    if let Some(rest) = text.strip_prefix("udp:") {
        let rest = address(rest);
        let any = rest
            .parse()
            .map(|port: u16| SocketAddr::from((Ipv4Addr::UNSPECIFIED, port)));
        return match any.or_else(|_| rest.parse()) {
            Ok(address) => Ok(Nav::Udp(address)),
            Err(_) => Err(refuse(
                "must be udp:PORT or udp://ADDRESS:PORT, for example udp:10110",
            )),
        };
    }
    if let Some(rest) = text.strip_prefix("tcp:") {
        let rest = address(rest);
        return match rest
            .rsplit_once(':')
            .is_some_and(|(host, port)| !host.is_empty() && port.parse::<u16>().is_ok())
        {
            true => Ok(Nav::Tcp(rest)),
            false => Err(refuse("must be tcp://HOST:PORT")),
        };
    }
    if let Some(rest) = text.strip_prefix("serial:") {
        let parts = rest
            .rsplit_once(':')
            .map(|(port, baud)| (port, baud.parse()));
        return match parts {
            Some((port, Ok(baud))) if !port.is_empty() => Ok(Nav::Serial(port.to_owned(), baud)),
            _ => Err(refuse(
                "must be serial:DEVICE:BAUD, for example serial:/dev/ttyUSB0:4800",
            )),
        };
    }
    let path = Path::new(text);
    let bytes = read_bounded(path, MAX_LOG_BYTES).map_err(|why| {
        refuse(&format!(
            "no address (udp:, tcp:, serial:), and as a file: {why}"
        ))
    })?;
    let path = beside(path, folder).map_err(|why| refuse(&why.to_string()))?;
    let text = String::from_utf8_lossy(&bytes);
    let first = text
        .lines()
        .find(|line| !line.trim().is_empty() && !line.starts_with('#'));
    match first.is_some_and(|line| line.starts_with("time_s,")) {
        true => Ok(Nav::Track(path)),
        false => Ok(Nav::Log(path)),
    }
}

fn seabed(path: &Path, range_m: f64, folder: &Path) -> Result<Seabed, Failure> {
    let spec = SeabedFileSpec::of(path.to_owned());
    let refuse = |rule: &str| refusal("--seabed", path.display(), rule);
    let survey = Survey::open(&FileSystem, &spec).map_err(|why| refuse(&why.to_string()))?;
    let middle_m = survey.field.percentiles_m(&[0.5]).first().copied();
    let depth_m = middle_m
        .filter(|&m| m > 0.0)
        .ok_or_else(|| refuse("half of it must lie below the water"))?;
    if depth_m > 0.9 * range_m {
        return Err(refusal(
            "--range-m",
            range_m,
            &format!(
                "must be above {:.0} m: half of {} is deeper than {depth_m:.1} m",
                (depth_m / 0.9).ceil(),
                path.display()
            ),
        ));
    }
    let path = beside(path, folder).map_err(|why| refuse(&why.to_string()))?;
    Ok(Seabed { path, depth_m })
}

// ---------------------------------------------------------------- size

/// The text of the rig at the rate that the sound allows, or at a lower one that two cores compute.
fn sized(request: &Request, design: &Design) -> Result<(String, Pace), Failure> {
    let sound = Pace {
        rate_hz: digits(design.sound_rate_hz, 3),
        compute_s: 0.0,
    };
    let mut spec = parsed(request, &text::text(request, design, sound))?;
    let track = tempfile::NamedTempFile::new().map_err(Failure::running)?;
    if let (Nav::Invented, NavInputSpec::Csv { path }) =
        (&request.nav, &mut spec.nav.sources[0].input)
    {
        *path = track.path().to_owned();
        std::fs::write(&path, track::text()).map_err(Failure::running)?;
    }
    let compute_s = compute_s(&spec)?;
    let computed_hz = 1.0 / (MARGIN * compute_s);
    let rate_hz = match sound.rate_hz > computed_hz {
        true => digits(0.99 * computed_hz, 2),
        false => sound.rate_hz,
    };
    let pace = Pace { rate_hz, compute_s };
    let text = text::text(request, design, pace);
    parsed(request, &text)?;
    Ok((text, pace))
}

/// The file system with the invented track, which is written last.
struct WithTrack(PathBuf);

impl Files for WithTrack {
    fn read(&self, path: &Path) -> Result<Vec<u8>, String> {
        config_files::FileSystem.read(path)
    }

    fn check_readable(&self, path: &Path) -> Result<(), String> {
        match path == self.0 {
            true => Ok(()),
            false => config_files::FileSystem.check_readable(path),
        }
    }

    fn is_folder_or_free(&self, path: &Path) -> bool {
        config_files::FileSystem.is_folder_or_free(path)
    }
}

fn parsed(request: &Request, text: &str) -> Result<RigSpec, Failure> {
    let files = WithTrack(request.folder.join(request.track_name()));
    echotank_config::parse(text, &request.folder, &files)
        .map_err(|errors| Failure::Configuration(format!("echotank new: {errors}")))
}

/// Estimated time of a ping of all sonars on two cores, seconds.
fn compute_s(spec: &RigSpec) -> Result<f64, Failure> {
    let refuse = |why: String| Failure::Configuration(format!("echotank new: {why}"));
    let pool = pool(spec.run.threads).map_err(Failure::running)?;
    let pings = pool
        .install(|| first(spec, &Costs::committed()))
        .map_err(|why| refuse(why.to_string()))?;
    let mut ms = 0.0;
    for (sonar, ping) in spec.sonars.iter().zip(&pings) {
        if ping.scatterers.is_empty() {
            return Err(refuse(format!(
                "the first ping of {} reaches no seabed within {} m: give a greater --range-m, or another --seabed",
                sonar.name, sonar.settings.range_m
            )));
        }
        let keeps = ping.ranking.as_ref().is_some_and(|r| r.is_within());
        let cost = ping.cost.filter(|_| keeps).ok_or_else(|| {
            refuse(format!("no method keeps the tolerance for {}: give fewer --elements, or a shorter --range-m", sonar.name))
        })?;
        ms += cost.wall_ms(CORES);
    }
    Ok(1e-3 * ms)
}

// ---------------------------------------------------------------- questions

/// Asks for the required parts that are missing, and for the others where nothing was given. An empty answer is the usual value.
fn ask(
    args: &mut NewArgs,
    input: &mut impl BufRead,
    output: &mut impl Write,
) -> Result<(), Failure> {
    let is_bare = args.kind.is_none();
    let kind = match args.kind {
        Some(kind) => kind,
        None => {
            let kinds = words(Kind::value_variants());
            let question = format!("Kind of sonar ({kinds}) [sidescan]");
            answer(&question, input, output, |text| match text {
                "" => Ok(Kind::Sidescan),
                text => parsed_word("the kind of sonar", text, Kind::value_variants()),
            })?
        }
    };
    args.kind = Some(kind);
    let (usual_khz, usual_m) = kind.usual();
    if args.frequency_khz.is_none() {
        let question = format!("Frequency, kHz [{usual_khz}]");
        let khz = answer(&question, input, output, |text| {
            frequency(number("--frequency-khz", text, usual_khz)?)
        })?;
        args.frequency_khz = Some(khz);
    }
    let khz = frequency(args.frequency_khz.unwrap_or(usual_khz))?;
    let elements = elements(kind, args.elements)?;
    if args.range_m.is_none() {
        let [shortest_m, longest_m] = Design::ranges_m(kind, 1e3 * khz, elements);
        let usual_m = usual_m.clamp(shortest_m, longest_m);
        let question = format!("Range, m [{usual_m}]");
        let range_m = answer(&question, input, output, |text| {
            range(kind, khz, elements, number("--range-m", text, usual_m)?)
        })?;
        args.range_m = Some(range_m);
    }
    if args.protocol.is_empty() {
        let first = kind.protocols()[0];
        let all = words(kind.protocols());
        let question = format!("Protocol ({all}; several with commas) [{}]", word(&first));
        args.protocol = answer(&question, input, output, |text| {
            if text.is_empty() {
                return Ok(vec![first]);
            }
            let parts = text.split(',').map(str::trim);
            let known = Protocol::value_variants();
            let asked: Result<Vec<_>, _> = parts
                .map(|part| parsed_word("--protocol", part, known))
                .collect();
            protocols(kind, &asked?)
        })?;
    }
    if !is_bare {
        return Ok(());
    }
    let given = |text: &str| (!text.is_empty()).then(|| text.to_owned());
    if args.nav.is_none() {
        let question =
            "Navigation (udp:PORT, serial:DEVICE:BAUD or a log file) [an invented track]";
        args.nav = answer(question, input, output, |text| match text {
            "" => Ok(None),
            text => nav(text, Path::new("")).map(|_| given(text)),
        })?;
    }
    if args.seabed.is_none() {
        let range_m = args.range_m.unwrap_or(usual_m);
        let question = "Seabed (a survey file) [flat sand]";
        args.seabed = answer(question, input, output, |text| match text {
            "" => Ok(None),
            text => seabed(Path::new(text), range_m, Path::new(""))
                .map(|_| given(text).map(PathBuf::from)),
        })?;
    }
    if args.out.is_none() {
        let question = format!("File to write [{}.toml]", word(&kind));
        args.out = answer(&question, input, output, |text| Ok(given(text)))?.map(PathBuf::from);
    }
    Ok(())
}

/// Asks until the answer is right.
fn answer<T>(
    question: &str,
    input: &mut impl BufRead,
    output: &mut impl Write,
    parse: impl Fn(&str) -> Result<T, Failure>,
) -> Result<T, Failure> {
    loop {
        write!(output, "{question}: ")
            .and_then(|()| output.flush())
            .map_err(Failure::running)?;
        let mut line = String::new();
        if input.read_line(&mut line).map_err(Failure::running)? == 0 {
            let text = format!("echotank new: no answer to `{question}`");
            return Err(Failure::Configuration(text));
        }
        match parse(line.trim()) {
            Ok(value) => return Ok(value),
            Err(Failure::Findings) => {}
            Err(Failure::Configuration(why) | Failure::Running(why)) => {
                writeln!(output, "{why}").map_err(Failure::running)?;
            }
        }
    }
}

fn number(argument: &str, text: &str, usual: f64) -> Result<f64, Failure> {
    match text {
        "" => Ok(usual),
        text => (text.parse()).map_err(|_| refusal(argument, text, "must be a number")),
    }
}

fn parsed_word<T: ValueEnum>(argument: &str, text: &str, known: &[T]) -> Result<T, Failure> {
    T::from_str(text, true).map_err(|_| {
        let rule = format!("must be one of {}", words(known));
        refusal(argument, text, &rule)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The answers, and the questions and refusals in return.
    fn asked(args: &mut NewArgs, answers: &str) -> (Result<(), Failure>, String) {
        let mut questions = Vec::new();
        let done = ask(args, &mut answers.as_bytes(), &mut questions);
        (done, String::from_utf8(questions).expect("text"))
    }

    #[test]
    fn empty_answers_give_the_usual_sidescan() {
        let mut args = NewArgs::default();
        let (done, questions) = asked(&mut args, "\n\n\n\n\n\n\n");
        assert!(done.is_ok(), "{questions}");
        assert_eq!(args.kind, Some(Kind::Sidescan));
        assert_eq!(
            (args.frequency_khz, args.range_m),
            (Some(455.0), Some(75.0))
        );
        assert_eq!(args.protocol, [Protocol::SevenK]);
        assert!(args.nav.is_none() && args.seabed.is_none() && args.out.is_none());
        assert_eq!(questions.matches("]: ").count(), 7, "{questions}");
    }

    #[test]
    fn a_wrong_answer_is_refused_and_asked_again() {
        let mut args = NewArgs {
            kind: Some(Kind::Multibeam),
            ..NewArgs::default()
        };
        let (done, questions) = asked(&mut args, "many\n0\n200\n1e6\n60\njsf\nwbms,7k\n");
        assert!(done.is_ok(), "{questions}");
        assert_eq!(
            (args.frequency_khz, args.range_m),
            (Some(200.0), Some(60.0))
        );
        assert_eq!(args.protocol, [Protocol::Wbms, Protocol::SevenK]);
        for rule in [
            "--frequency-khz many: must be a number",
            "--frequency-khz 0: must be 5 to 1500 kHz",
            "--range-m 1000000: must be",
            "--protocol jsf: does not suit a multibeam",
        ] {
            assert!(questions.contains(rule), "no `{rule}`: {questions}");
        }
    }

    #[test]
    fn an_input_that_ends_is_an_error() {
        let (done, _) = asked(&mut NewArgs::default(), "board\n");
        assert!(matches!(done, Err(Failure::Configuration(why)) if why.contains("Frequency")));
    }
}
