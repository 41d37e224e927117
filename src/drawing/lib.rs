//! A small SVG writer, and a renderer from SVG to PNG.

#![warn(missing_docs)]

use std::fmt::Write;
use std::sync::Arc;

use resvg::tiny_skia::{Pixmap, Transform};
use resvg::usvg::{Options, Tree, fontdb};

/// Embedded typeface, so that plots are the same on every machine.
const FONT: &[u8] = epaint_default_fonts::UBUNTU_LIGHT;
/// Name of the embedded typeface, for `font-family`.
pub const FAMILY: &str = "Ubuntu";
/// PNG pixels per SVG unit.
const ZOOM: f32 = 1.5;

/// Colour of text and axes.
pub const INK: &str = "#1b1f24";
/// Colour of secondary lines and labels.
pub const GREY: &str = "#8a9099";
/// Colour of grid lines.
pub const PALE: &str = "#e4e7eb";

/// Escapes text for XML.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

/// An SVG document under construction.
pub struct Svg {
    text: String,
}

/// Horizontal alignment of a text at its position.
#[derive(Clone, Copy)]
pub enum Anchor {
    /// The text starts at the position.
    Start,
    /// The middle of the text is at the position.
    Middle,
    /// The text ends at the position.
    End,
}

impl Svg {
    /// Creates an empty document with a white background, `width` x `height` units.
    pub fn new(width: f64, height: f64) -> Self {
        let text = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" font-family=\"{FAMILY}, 'Segoe UI', Helvetica, sans-serif\">\n<rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n"
        );
        Self { text }
    }

    /// Appends an element unchanged. The caller escapes its text.
    pub fn raw(&mut self, element: &str) {
        self.text.push_str(element);
        self.text.push('\n');
    }

    /// Appends a line between two points. `dash` is a `stroke-dasharray`, empty for a solid line.
    pub fn line(&mut self, (x1, y1): (f64, f64), (x2, y2): (f64, f64), colour: &str, dash: &str) {
        let _ = writeln!(
            self.text,
            "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{colour}\" stroke-dasharray=\"{dash}\"/>"
        );
    }

    /// Appends lines through `points`, `width` units thick.
    pub fn polyline(&mut self, points: &[(f64, f64)], colour: &str, width: f64) {
        let points: Vec<String> = points
            .iter()
            .map(|(x, y)| format!("{x:.1},{y:.1}"))
            .collect();
        let _ = writeln!(
            self.text,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\"/>",
            points.join(" ")
        );
    }

    /// Appends a text of height `size` at a point of its base line. The text is escaped.
    pub fn label(
        &mut self,
        (x, y): (f64, f64),
        size: f64,
        anchor: Anchor,
        colour: &str,
        text: &str,
    ) {
        let anchor = match anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        let _ = writeln!(
            self.text,
            "<text x=\"{x:.1}\" y=\"{y:.1}\" font-size=\"{size}\" text-anchor=\"{anchor}\" fill=\"{colour}\">{}</text>",
            escaped(text)
        );
    }

    /// Returns the SVG text of the document.
    pub fn finish(mut self) -> String {
        self.text.push_str("</svg>\n");
        self.text
    }
}

/// Estimated width of a text of height `size`, in the same units. The estimate is accurate enough to separate labels.
pub fn width_of(text: &str, size: f64) -> f64 {
    0.52 * size * text.chars().count() as f64
}

/// Errors of rendering a document to PNG.
#[derive(Debug, thiserror::Error)]
pub enum DrawError {
    /// The document is not valid SVG.
    #[error("cannot render the SVG: {0}")]
    Svg(#[from] resvg::usvg::Error),
    /// The pixels cannot be allocated.
    #[error("the image is too large to allocate")]
    Size,
    /// The PNG encoder failed, with its message.
    #[error("cannot encode the PNG: {0}")]
    Png(String),
}

/// Renders an SVG document to the bytes of a PNG, with 1.5 pixels per unit and the embedded typeface.
///
/// # Errors
/// The SVG is invalid, the image is too large, or the encoder fails.
pub fn png(svg: &str) -> Result<Vec<u8>, DrawError> {
    let mut fonts = fontdb::Database::new();
    fonts.load_font_data(FONT.to_vec());
    let options = Options {
        fontdb: Arc::new(fonts),
        font_family: FAMILY.into(),
        ..Options::default()
    };
    let tree = Tree::from_str(svg, &options)?;
    let size = tree.size();
    let (width, height) = (size.width() * ZOOM, size.height() * ZOOM);
    let mut pixels = Pixmap::new(width as u32, height as u32).ok_or(DrawError::Size)?;
    resvg::render(
        &tree,
        Transform::from_scale(ZOOM, ZOOM),
        &mut pixels.as_mut(),
    );
    pixels
        .encode_png()
        .map_err(|why| DrawError::Png(why.to_string()))
}
