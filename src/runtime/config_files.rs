//! Configurations in the file system.

use std::io::{self, Read};
use std::path::{Path, PathBuf};

use echotank_config::spec::RigSpec;
use echotank_config::{ConfigErrors, Files, Problem};

/// Maximum size of a configuration and of each table that the configuration names, bytes.
const MAX_CONFIGURATION_BYTES: u64 = 16 << 20;

/// File system of this computer.
#[derive(Clone, Copy, Debug)]
pub struct FileSystem;

impl Files for FileSystem {
    fn read(&self, path: &Path) -> Result<Vec<u8>, String> {
        read_bounded(path, MAX_CONFIGURATION_BYTES)
    }

    fn check_readable(&self, path: &Path) -> Result<(), String> {
        regular(path)?;
        match std::fs::File::open(path) {
            Ok(_) => Ok(()),
            Err(error) => Err(reason(&error)),
        }
    }

    fn is_folder_or_free(&self, path: &Path) -> bool {
        path.is_dir() || !path.exists()
    }
}

/// Reads a regular file of at most `max_bytes`.
///
/// # Errors
/// The reason, without the path.
pub fn read_bounded(path: &Path, max_bytes: u64) -> Result<Vec<u8>, String> {
    regular(path)?;
    let mut bytes = Vec::new();
    // One byte more than the limit shows that a file is too large or grows.
    std::fs::File::open(path)
        .and_then(|file| file.take(max_bytes + 1).read_to_end(&mut bytes))
        .map_err(|error| reason(&error))?;
    if bytes.len() as u64 > max_bytes {
        let len = std::fs::metadata(path).map_or(bytes.len() as u64, |m| m.len());
        return Err(format!("{len} bytes; at most {max_bytes} are read"));
    }
    Ok(bytes)
}

/// Refuses folders, pipes and devices; pipes and devices can be endless.
fn regular(path: &Path) -> Result<(), String> {
    let metadata = std::fs::metadata(path).map_err(|error| reason(&error))?;
    match metadata.is_file() {
        true => Ok(()),
        false => Err("not a file".to_owned()),
    }
}

/// Describes an error with the same words on every system.
fn reason(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::NotFound => "not found".to_owned(),
        io::ErrorKind::PermissionDenied => "no permission".to_owned(),
        _ => error.to_string(),
    }
}

/// Reads the text of a configuration file.
///
/// # Errors
/// The reason, without the path.
pub fn read_text(path: &Path) -> Result<String, String> {
    String::from_utf8(FileSystem.read(path)?).map_err(|error| error.to_string())
}

/// Reads and checks a configuration file, and checks that the files it names can be read.
///
/// # Errors
/// All violations of the configuration's rules.
pub fn load(path: &Path) -> Result<RigSpec, ConfigErrors> {
    echotank_config::load(path, &FileSystem)
}

/// Checks the text of a configuration. Relative file names are resolved against `folder`.
///
/// # Errors
/// All violations of the configuration's rules.
pub fn parse(text: &str, folder: &Path) -> Result<RigSpec, ConfigErrors> {
    echotank_config::parse(text, folder, &FileSystem)
}

/// Like [`load`], after `overrides` such as `sonar.ping.range_m=75`. In an array of tables an override changes every entry, or only the entry with
/// the index in the key. Absent tables are created. A value that is not TOML is taken as a string.
///
/// # Errors
/// All violations of the configuration's rules, or an override that cannot be applied.
pub fn load_with(path: &Path, overrides: &[String]) -> Result<RigSpec, LoadError> {
    load_from(path, overrides, &FileSystem)
}

/// Like [`load_with`], with the files that the configuration names taken from `files`.
pub(crate) fn load_from(
    path: &Path,
    overrides: &[String],
    files: &dyn Files,
) -> Result<RigSpec, LoadError> {
    if overrides.is_empty() {
        return Ok(echotank_config::load(path, files)?);
    }
    let name = path.display();
    let text = read_text(path).map_err(|why| LoadError::Override(format!("{name}: {why}")))?;
    let Ok(mut table) = text.parse::<toml::Table>() else {
        return Ok(load(path)?);
    };
    for change in overrides {
        apply(&mut table, change)
            .map_err(|why| LoadError::Override(format!("--set {change}: {why}")))?;
    }
    let text = toml::to_string(&table).map_err(|e| LoadError::Override(e.to_string()))?;
    let folder = path.parent().unwrap_or(Path::new("."));
    let parsed = echotank_config::parse(&text, folder, files);
    parsed.map_err(|errors| LoadError::Overridden {
        file: path.to_owned(),
        // The lines are those of the text with the overrides, which nobody sees.
        errors: errors.without_lines(),
    })
}

/// Errors of reading a configuration with overrides.
#[derive(Clone, Debug, thiserror::Error)]
pub enum LoadError {
    /// The file violates rules of the configuration.
    #[error(transparent)]
    File(#[from] ConfigErrors),
    /// The file with the overrides violates rules of the configuration.
    #[error("{} (with --set)\n{errors}", file.display())]
    Overridden {
        /// The file.
        file: PathBuf,
        /// Problems without lines.
        errors: ConfigErrors,
    },
    /// The file cannot be read or an override cannot be applied; the text names it, and the reason.
    #[error("{0}")]
    Override(String),
}

impl LoadError {
    /// The violated rules; none of an override that cannot be applied.
    pub fn problems(&self) -> &[Problem] {
        match self {
            Self::File(errors) | Self::Overridden { errors, .. } => &errors.problems,
            Self::Override(_) => &[],
        }
    }
}

fn apply(table: &mut toml::Table, change: &str) -> Result<(), String> {
    let (key, value) = change.split_once('=').ok_or("expected KEY=VALUE")?;
    let value = parse_value(value.trim());
    let path: Vec<&str> = key.trim().split('.').collect();
    if path.iter().any(|part| part.is_empty()) {
        return Err("the key has an empty part".into());
    }
    set_in(table, &path, &value)
}

fn parse_value(text: &str) -> toml::Value {
    match format!("v = {text}").parse::<toml::Table>() {
        Ok(mut table) => table
            .remove("v")
            .unwrap_or_else(|| toml::Value::String(text.into())),
        Err(_) => toml::Value::String(text.into()),
    }
}

fn set_in(table: &mut toml::Table, path: &[&str], value: &toml::Value) -> Result<(), String> {
    let (first, rest) = path.split_first().ok_or("empty key")?;
    if rest.is_empty() {
        table.insert((*first).to_string(), value.clone());
        return Ok(());
    }
    let next = table
        .entry((*first).to_string())
        .or_insert_with(|| toml::Value::Table(toml::Table::new()));
    match next {
        toml::Value::Table(inner) => set_in(inner, rest, value),
        toml::Value::Array(entries) => {
            let (one, below) = match rest[0].parse::<usize>() {
                Ok(index) => (Some(index), &rest[1..]),
                Err(_) => (None, rest),
            };
            if one.is_some_and(|index| index >= entries.len()) {
                return Err(format!("{first} has {} entries", entries.len()));
            }
            for (index, entry) in entries.iter_mut().enumerate() {
                if one.is_none_or(|wanted| wanted == index) {
                    let inner = entry
                        .as_table_mut()
                        .ok_or_else(|| format!("{first} is not a list of tables"))?;
                    set_in(inner, below, value)?;
                }
            }
            Ok(())
        }
        _ => Err(format!("{first} is a value, not a table")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn problems_with_overrides_name_keys_and_no_lines_of_another_text() {
        let file = echotank_testing::repository().join("hil-configs/quickstart.toml");
        let said = load_with(&file, &["sonar.ping.range_m=-1".into()]).unwrap_err();
        assert_eq!(said.problems().len(), 1, "{said}");
        let said = said.to_string();
        assert!(said.contains("sonar[0].ping.range_m"), "{said}");
        assert!(!said.contains("line "), "{said}");
    }

    #[test]
    fn an_override_changes_every_sonar_or_the_indexed_one() {
        let mut table: toml::Table = "[[sonar]]\nname = 'a'\n[[sonar]]\nname = 'b'\n"
            .parse()
            .unwrap();
        apply(&mut table, "sonar.ping.range_m=75").unwrap();
        apply(&mut table, "sonar.1.name=c").unwrap();
        let text = toml::to_string(&table).unwrap();
        assert_eq!(text.matches("range_m = 75").count(), 2, "{text}");
        assert!(
            text.contains("name = \"a\"") && text.contains("name = \"c\""),
            "{text}"
        );
        assert!(apply(&mut table, "sonar.7.name=c").is_err());
        assert!(apply(&mut table, "sonar").is_err());
        assert!(apply(&mut table, "sonar..name=1").is_err());
    }
}
