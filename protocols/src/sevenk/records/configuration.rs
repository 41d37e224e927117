//! Record 7001 (configuration): description of the sonar, sent on request. Source: DFD 3.12.
//!
//! ```text
//! RTH   0 u64 sonar_id   8 u32 modules                                                                            12 bytes
//! RD    per module: u32 identifier, char[60] description, u32 alphadata_card, u64 serial, u32 info_length L, L bytes of XML
//! ```
//!
//! Teledyne's reader drops the last byte of the XML and requires exactly one 7001 in a file. The text therefore ends with one NUL,
//! which L includes, and a file contains one 7001.

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{data_at, rth};
use crate::layout::layout_of;
use crate::sevenk::frame::{Layout, OpenRecord, RecordStamp, read_fixed, write_layout};
use crate::sevenk::{WireError, record_id};

#[derive(Debug, Clone, Copy, BinRead, BinWrite)]
struct Rth7001 {
    sonar_id: u64,
    modules: u32,
}

#[derive(Debug, Clone, Copy, BinRead, BinWrite)]
struct ModuleHead {
    identifier: u32,
    description: [u8; 60],
    alphadata_card: u32,
    serial_number: u64,
    info_length: u32,
}

rth!(Rth7001, 12, "7001 configuration");

layout_of!(ModuleHead, 80, "7001 module", Little);

/// Record 7001 (configuration): modules of a sonar.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Configuration7001 {
    /// Serial number of the sonar.
    pub sonar_id: u64,
    /// Modules of the sonar.
    pub modules: Vec<Module>,
}

/// One module of a sonar.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Module {
    /// Device identifier of the module.
    pub identifier: u32,
    /// Description of the module; at most 59 bytes are emitted.
    pub description: String,
    /// Alphadata card: 0x400, 0x800 or 0x1000.
    pub alphadata_card: u32,
    /// Serial number of the module.
    pub serial_number: u64,
    /// Description in XML, without the final NUL.
    pub info_xml: String,
}

impl Configuration7001 {
    /// Size of the record type header, bytes.
    pub const RTH_BYTES: usize = Rth7001::RTH_BYTES;

    /// Parses the body of the record. Returns an error if the body is too short.
    pub fn parse(body: &[u8]) -> Result<Self, WireError> {
        let rth: Rth7001 = read_fixed(body)?;
        let mut at = Rth7001::RTH_BYTES;
        let mut modules = Vec::new();
        for _ in 0..rth.modules {
            let head: ModuleHead = read_fixed(data_at(
                body,
                at,
                ModuleHead::SIZE_BYTES as u64,
                ModuleHead::NAME,
            )?)?;
            at += ModuleHead::SIZE_BYTES;
            let info = data_at(
                body,
                at,
                u64::from(head.info_length),
                "7001 module information",
            )?;
            at += info.len();
            modules.push(Module {
                identifier: head.identifier,
                description: text_of(&head.description),
                alphadata_card: head.alphadata_card,
                serial_number: head.serial_number,
                info_xml: text_of(info),
            });
        }
        Ok(Self {
            sonar_id: rth.sonar_id,
            modules,
        })
    }

    /// Appends the record and returns its byte range.
    pub fn emit(&self, buf: &mut Vec<u8>, stamp: &RecordStamp) -> Range<usize> {
        emit_7001(buf, stamp, self.sonar_id, &self.modules)
    }
}

/// Appends a record 7001 (configuration). Texts are truncated at their first NUL, the description also to 59 bytes.
pub fn emit_7001(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    sonar_id: u64,
    modules: &[Module],
) -> Range<usize> {
    let open = OpenRecord::begin(buf, record_id::CONFIGURATION, stamp);
    write_layout(
        &Rth7001 {
            sonar_id,
            modules: modules.len() as u32,
        },
        buf,
    );
    for module in modules {
        let info = before_nul(&module.info_xml);
        let head = ModuleHead {
            identifier: module.identifier,
            description: text_field(&module.description),
            alphadata_card: module.alphadata_card,
            serial_number: module.serial_number,
            info_length: info.len() as u32 + 1,
        };
        write_layout(&head, buf);
        buf.extend_from_slice(info.as_bytes());
        buf.push(0);
    }
    open.finish(buf)
}

fn before_nul(text: &str) -> &str {
    text.split('\0').next().unwrap_or_default()
}

/// Text as a field of fixed length that ends with a NUL. Longer texts are truncated between characters.
pub(crate) fn text_field<const N: usize>(text: &str) -> [u8; N] {
    let text = before_nul(text);
    let fitting = (0..=text.len().min(N - 1))
        .rev()
        .find(|&end| text.is_char_boundary(end))
        .unwrap_or(0);
    let mut field = [0; N];
    field[..fitting].copy_from_slice(&text.as_bytes()[..fitting]);
    field
}

/// Text of a field up to its first NUL. Invalid UTF-8 is replaced.
pub(crate) fn text_of(field: &[u8]) -> String {
    String::from_utf8_lossy(field.split(|&byte| byte == 0).next().unwrap_or_default()).into_owned()
}

impl fmt::Display for Configuration7001 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "configuration of sonar {}, {} modules",
            self.sonar_id,
            self.modules.len()
        )?;
        for module in &self.modules {
            write!(
                f,
                "; {} {:?} serial {}, {} B of XML",
                module.identifier,
                module.description,
                module.serial_number,
                module.info_xml.len()
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_fields_always_end_in_a_nul_and_never_cut_a_character() {
        assert_eq!(text_field::<4>("abc"), *b"abc\0");
        assert_eq!(text_field::<4>("abcdef"), *b"abc\0");
        assert_eq!(text_field::<4>("ab\u{e9}"), *b"ab\0\0");
        assert_eq!(text_field::<4>("a\0b"), *b"a\0\0\0");
        assert_eq!(text_of(b"a\0b"), "a");
        assert_eq!(text_of(b"no nul"), "no nul");
    }
}
