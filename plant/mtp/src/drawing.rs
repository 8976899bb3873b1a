//! Draws a picture as SVG: boxes with names for objects, lines for connections.

use std::collections::HashMap;
use std::fmt::Write as _;

use xml_text::xml_printable;

use crate::model::DataAssembly;
use crate::picture::{ModulePicture, PictureConnection, PictureObject};

impl ModulePicture {
    /// Draws the picture. `assemblies` are those of its module, whose names and kinds are the
    /// tooltips of objects. Objects without a position are left out.
    #[must_use]
    pub fn svg(&self, assemblies: &[DataAssembly]) -> String {
        let assemblies: HashMap<&str, &DataAssembly> =
            assemblies.iter().map(|one| (&*one.id, one)).collect();
        let [width, height] = self.extent();
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"0 0 {width} {height}\">\n<title>{}</title>\n<style>{STYLE}</style>\n\
             <defs><marker id=\"end\" viewBox=\"0 0 8 8\" refX=\"8\" refY=\"4\" markerWidth=\"8\" \
             markerHeight=\"8\" orient=\"auto\"><path d=\"M0 0L8 4L0 8z\"/></marker></defs>\n\
             <rect class=\"picture\" width=\"{width}\" height=\"{height}\"/>\n",
            xml_printable(&self.name)
        );
        let mut connections: Vec<&PictureConnection> = self.connections.iter().collect();
        connections.sort_by(|one, other| one.layer.total_cmp(&other.layer));
        for connection in connections {
            line(&mut svg, connection);
        }
        let mut objects: Vec<&PictureObject> = self.objects.iter().collect();
        objects.sort_by(|one, other| one.layer.total_cmp(&other.layer));
        for object in objects {
            let assembly = object.assembly.as_deref();
            let assembly = assembly.and_then(|id| assemblies.get(id).copied());
            shape(&mut svg, object, assembly);
        }
        svg.push_str("</svg>\n");
        svg
    }

    /// Returns the width and height of the picture, or of its parts if the file has none.
    fn extent(&self) -> [f64; 2] {
        if let Some(size) = self.size.filter(|size| size.iter().all(|one| *one > 0.0)) {
            return size;
        }
        let corners = self.objects.iter().filter_map(|object| {
            let [x, y] = object.position?;
            let [width, height] = object.size.unwrap_or_default();
            Some([x + width, y + height])
        });
        let points = self.connections.iter().flat_map(|one| one.path.clone());
        let corners = corners.chain(points);
        let [width, height] = corners.fold([0.0_f64, 0.0], |[width, height], [x, y]| {
            [width.max(x), height.max(y)]
        });
        [width + MARGIN, height + MARGIN]
    }
}

/// Adds a connection. Writing to a String cannot fail.
fn line(svg: &mut String, connection: &PictureConnection) {
    let points = connection.path.iter().map(|[x, y]| format!("{x},{y}"));
    let points: Vec<String> = points.collect();
    let class = match connection.class.as_str() {
        "Pipe" => "pipe",
        _ => "signal",
    };
    let end = match connection.is_directed {
        true => " marker-end=\"url(#end)\"",
        false => "",
    };
    let _written = writeln!(
        svg,
        "<polyline class=\"{class}\" points=\"{}\"{end}><title>{} ({})</title></polyline>",
        points.join(" "),
        xml_printable(&connection.name),
        xml_printable(&connection.class)
    );
}

/// Adds an object. X and Y are the upper left corner, also for sources and sinks. The file gives
/// the width and height after the rotation, so the box is drawn without a rotation. A device
/// without a size has its name only.
fn shape(svg: &mut String, object: &PictureObject, assembly: Option<&DataAssembly>) {
    let Some([x, y]) = object.position else {
        return;
    };
    let about = match assembly {
        Some(assembly) => format!("{} ({})", assembly.name, assembly.kind),
        None => object.class.clone(),
    };
    let _written = write!(svg, "<g class=\"{}\"><title>", kind(object));
    let _written = write!(svg, "{}</title>", xml_printable(&about));
    let name = xml_printable(&object.name);
    let [middle, below] = match object.size {
        Some([width, height]) => {
            let [middle, centre] = [x + width / 2.0, y + height / 2.0];
            let _written = write!(
                svg,
                "<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" rx=\"4\"/>"
            );
            [middle, centre]
        }
        None if !object.is_topology => [x, y],
        None => {
            let [middle, centre] = [x + END, y + END];
            let _written = write!(svg, "<circle cx=\"{middle}\" cy=\"{centre}\" r=\"{END}\"/>");
            [middle, centre + END + TEXT]
        }
    };
    let _written = writeln!(svg, "<text x=\"{middle}\" y=\"{below}\">{name}</text></g>");
}

/// Returns the class of an object in the style of the drawing.
fn kind(object: &PictureObject) -> &'static str {
    match (object.size, &object.assembly) {
        (None, _) if object.is_topology => "end",
        (Some(_), Some(_)) => "device",
        (_, None) | (None, _) => "plain",
    }
}

/// The margin of a picture without a size.
const MARGIN: f64 = 20.0;
/// The radius of the end of a flow.
const END: f64 = 6.0;
/// The size of text.
const TEXT: f64 = 11.0;
const STYLE: &str = "text{font:11px sans-serif;text-anchor:middle;fill:#222}\
    .picture{fill:#fff}\
    .pipe{fill:none;stroke:#345;stroke-width:3}\
    .signal{fill:none;stroke:#789;stroke-width:1;stroke-dasharray:5 3}\
    .device rect{fill:#e3eef8;stroke:#246}\
    .plain rect{fill:#f3f3f3;stroke:#777}\
    .end circle{fill:#fff;stroke:#345;stroke-width:2}";
