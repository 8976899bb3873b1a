//! Pictures of a module for operators (HMI, VDI/VDE/NAMUR 2658-2): their objects, connections and
//! links.

use std::collections::{BTreeMap, HashMap};
use std::ops::RangeInclusive;

use thiserror::Error;

use crate::caex::CaexElement;
use crate::model::MtpFinding;
use crate::read::{ElementIndex, is_true};

/// A picture. Its origin is the upper left corner; lengths are in pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct ModulePicture {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// Its level in the hierarchy of pictures, such as `0` or `1.2`; empty if the file has none.
    pub level: String,
    /// Its width and height.
    pub size: Option<[f64; 2]>,
    /// Its objects, in the order of the file.
    pub objects: Vec<PictureObject>,
    /// Its connections, in the order of the file.
    pub connections: Vec<PictureConnection>,
    /// The links of ports, by their IDs.
    pub links: Vec<[String; 2]>,
}

/// An object of a picture: a device (VisualObject), or an end of a flow (TopologyObject).
#[derive(Debug, Clone, PartialEq)]
pub struct PictureObject {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// The last part of its type, such as `VisualObject`, `Source` or `Sink`.
    pub class: String,
    /// Whether it is an end or a junction of flows (TopologyObject), not a device.
    pub is_topology: bool,
    /// The name of its SemanticGroup, behind the groups around it, with slashes between them: its
    /// first 200 characters. Empty without a group.
    pub group: String,
    /// X and Y of its upper left corner.
    pub position: Option<[f64; 2]>,
    /// Its width and height, if the file has them.
    pub size: Option<[f64; 2]>,
    /// The rotation of its symbol in degrees; its size is that of the rotated symbol.
    pub rotation: f64,
    /// Its layer: objects of a higher layer hide those of a lower layer.
    pub layer: f64,
    /// The type of its view (ViewType); empty if the file has none.
    pub view: String,
    /// Its class in ECLASS, such as `27143121`; empty if the file has none.
    pub eclass: String,
    /// The version of ECLASS; empty if the file has none.
    pub eclass_version: String,
    /// The IRDI of its class in ECLASS; empty if the file has none.
    pub eclass_irdi: String,
    /// The ID of its data assembly.
    pub assembly: Option<String>,
    /// Its ports.
    pub ports: Vec<PicturePort>,
}

/// A connection of a picture, such as a pipe.
#[derive(Debug, Clone, PartialEq)]
pub struct PictureConnection {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// The last part of its type, such as `Pipe`, `MeasurementLine` or `FunctionLine`.
    pub class: String,
    /// The name of its SemanticGroup, behind the groups around it, with slashes between them: its
    /// first 200 characters. Empty without a group.
    pub group: String,
    /// X and Y of its points (Edgepath).
    pub path: Vec<[f64; 2]>,
    /// Its layer: connections of a higher layer hide those of a lower layer.
    pub layer: f64,
    /// Whether it has a direction, from its first to its last point.
    pub is_directed: bool,
    /// Its ports.
    pub ports: Vec<PicturePort>,
}

/// A port of an object or a connection.
#[derive(Debug, Clone, PartialEq)]
pub struct PicturePort {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// The last part of its type, such as `Nozzle`; empty if the file has none.
    pub class: String,
    /// Its X and Y.
    pub position: Option<[f64; 2]>,
}

impl ModulePicture {
    /// Returns the neighbours of each part that has links: by the ID of an object or a connection,
    /// the IDs of the objects and connections that links join with it, with their names. Parts
    /// without an ID are left out.
    #[must_use]
    pub fn neighbours(&self) -> BTreeMap<&str, BTreeMap<&str, &str>> {
        let owners: HashMap<&str, (&str, &str)> = self.ports().collect();
        let mut found: BTreeMap<&str, BTreeMap<&str, &str>> = BTreeMap::new();
        for link in &self.links {
            let [first, second] = link.each_ref().map(|port| owners.get(&**port).copied());
            let (Some(first), Some(second)) = (first, second) else {
                continue;
            };
            for ((of, _), (neighbour, name)) in [(first, second), (second, first)] {
                found.entry(of).or_default().insert(neighbour, name);
            }
        }
        found
    }

    /// Returns the ID of each port with the ID and the name of its object or connection. Objects
    /// and connections without an ID are left out.
    fn ports(&self) -> impl Iterator<Item = (&str, (&str, &str))> {
        let objects = self.objects.iter();
        let objects = objects.map(|one| (&one.id, &one.name, &one.ports));
        let connections = self.connections.iter();
        let connections = connections.map(|one| (&one.id, &one.name, &one.ports));
        let parts = objects.chain(connections);
        parts
            .filter(|(id, ..)| !id.is_empty())
            .flat_map(|(id, name, ports)| ports.iter().map(|port| (&*port.id, (&**id, &**name))))
    }
}

impl PictureConnection {
    /// Returns the points of an Edgepath, as `1,2;3,4`. `None` if it has another form, or a number
    /// that is too large or too small for a picture.
    #[must_use]
    pub fn points(edge_path: &str) -> Option<Vec<[f64; 2]>> {
        points(edge_path).ok()
    }
}

/// The parts of pictures while they are read.
#[derive(Default)]
pub(crate) struct PictureParts<'a> {
    /// The index of the picture that is read.
    picture: usize,
    /// Maps the ID of a port, and the ID of each interface of a port, to the ID of the port. The
    /// key includes the index of the picture.
    ports: BTreeMap<(&'a str, usize), &'a str>,
    /// Elements without a place in the model.
    left_out: Vec<&'a CaexElement>,
}

impl<'a> ElementIndex<'a> {
    /// Reads all pictures below an element. Returns the elements of pictures that have no place in
    /// the model too.
    pub(crate) fn pictures(
        &mut self,
        root: &'a CaexElement,
    ) -> (Vec<ModulePicture>, Vec<&'a CaexElement>) {
        let mut parts = PictureParts::default();
        let elements: Vec<&CaexElement> = root.all().filter(|one| is_picture(one)).collect();
        let mut pictures: Vec<ModulePicture> = Vec::new();
        for element in &elements {
            parts.picture = pictures.len();
            pictures.push(self.picture(element, &mut parts));
        }
        // Links are resolved after all pictures are read, because a link may precede its ports in
        // the file.
        for (at, (element, picture)) in elements.iter().zip(&mut pictures).enumerate() {
            for link in parts_of(element).flat_map(|part| &part.links) {
                let what = match link.sides.each_ref().map(|side| parts.port(side, at)) {
                    [Some((of_first, first)), Some((of_second, second))]
                        if of_first == at && of_second == at =>
                    {
                        picture.links.push([first, second].map(str::to_owned));
                        continue;
                    }
                    [Some(_), Some(_)] => "a side of the InternalLink is in another picture",
                    _ => "a side of the InternalLink names no port of a picture",
                };
                let about = format!("{}: {} - {}", picture.name, link.sides[0], link.sides[1]);
                self.find_at(link.line, &about, what);
            }
        }
        (pictures, parts.left_out)
    }

    fn picture(&mut self, element: &'a CaexElement, parts: &mut PictureParts<'a>) -> ModulePicture {
        let missing = Some("the picture has no Width or no Height");
        let size = self.size(element, &element.name, missing);
        let mut picture = ModulePicture {
            id: element.id.clone(),
            name: element.name.clone(),
            level: text(element, "HierarchyLevel"),
            size,
            objects: Vec::new(),
            connections: Vec::new(),
            links: Vec::new(),
        };
        let picture_name = &element.name;
        let children = |of: &'a CaexElement| of.children.iter().rev();
        let mut waiting: Vec<(&CaexElement, String)> = children(element)
            .map(|child| (child, String::new()))
            .collect();
        while let Some((part, group)) = waiting.pop() {
            match PartClass::of(part) {
                Some(PartClass::Picture) => {}
                Some(PartClass::Group) => {
                    let inner = match group.is_empty() {
                        true => shortened(&part.name),
                        false => shortened(&format!("{group}/{}", part.name)),
                    };
                    waiting.extend(children(part).map(|child| (child, inner.clone())));
                }
                Some(PartClass::Object { is_topology }) => {
                    let about = format!("{picture_name}/{}", part.name);
                    let mut object = self.object(part, &about, is_topology);
                    object.group = group;
                    object.ports = self.ports(part, &about, parts);
                    picture.objects.push(object);
                }
                Some(PartClass::Connection) => {
                    let about = format!("{picture_name}/{}", part.name);
                    let ports = self.ports(part, &about, parts);
                    let connection = self.connection(part, &about, (group, ports));
                    picture.connections.push(connection);
                }
                None => parts.leave_out(part),
            }
        }
        picture
    }

    fn object(
        &mut self,
        element: &'a CaexElement,
        about: &str,
        is_topology: bool,
    ) -> PictureObject {
        if element.id.is_empty() {
            self.find(element, about, "the object has no ID, so no link joins it");
        }
        let missing = Some("the object has no position (X and Y)");
        let position = self.pair(element, about, (["X", "Y"], missing));
        let missing = (!is_topology).then_some("the object has no Width or no Height");
        let size = self.size(element, about, missing);
        let assembly = self.value_assembly(element).map(|one| one.id.clone());
        if let (None, Some(id)) = (&assembly, element.value(&["RefID"])) {
            // Files have RefIDs of tanks and pipes too, which have no variables.
            self.add(MtpFinding {
                about: about.to_owned(),
                what: format!("no data assembly has its RefID `{id}`, so it shows no values"),
                line: element.line,
                is_note: true,
            });
        }
        PictureObject {
            id: element.id.clone(),
            name: element.name.clone(),
            class: element.kind().to_owned(),
            is_topology,
            group: String::new(),
            position,
            size,
            rotation: self.number(element, about, "Rotation").unwrap_or(0.0),
            layer: self.number(element, about, "ZIndex").unwrap_or(0.0),
            view: text(element, "ViewType"),
            eclass: text(element, "eClassClassificationClass"),
            eclass_version: text(element, "eClassVersion"),
            eclass_irdi: text(element, "eClassIRDI"),
            assembly,
            ports: Vec::new(),
        }
    }

    fn connection(
        &mut self,
        element: &'a CaexElement,
        about: &str,
        (group, ports): (String, Vec<PicturePort>),
    ) -> PictureConnection {
        if element.id.is_empty() {
            let what = "the connection has no ID, so no link joins it";
            self.find(element, about, what);
        }
        let edges = element.value(&["Edgepath"]);
        let path = match edges {
            Some(edges) => points(edges),
            None => Ok(ports.iter().filter_map(|port| port.position).collect()),
        };
        let edges = edges.unwrap_or_default();
        let fault = match &path {
            Ok(path) if path.len() > 1 => None,
            Ok(_) => Some("the connection has no Edgepath with two points".to_owned()),
            Err(PictureNumberFault::Text) => Some(format!(
                "its Edgepath `{edges}` is no list of points, as `1,2;3,4`"
            )),
            Err(PictureNumberFault::Magnitude) => Some(format!(
                "its Edgepath `{edges}` has a number that is too large or too small for a picture"
            )),
        };
        if let Some(fault) = fault {
            self.find(element, about, &fault);
        }
        PictureConnection {
            id: element.id.clone(),
            name: element.name.clone(),
            class: element.kind().to_owned(),
            group,
            path: path.unwrap_or_default(),
            layer: self.number(element, about, "ZIndex").unwrap_or(0.0),
            is_directed: is_true(element.value(&["Directed"])),
            ports,
        }
    }

    fn ports(
        &mut self,
        of: &'a CaexElement,
        about: &str,
        parts: &mut PictureParts<'a>,
    ) -> Vec<PicturePort> {
        let mut ports = Vec::new();
        for element in &of.children {
            if !is_port(element) {
                parts.leave_out(element);
                continue;
            }
            let about = format!("{about}/{}", element.name);
            if element.id.is_empty() {
                self.find(element, &about, "the port has no ID, so nothing links it");
            } else {
                parts.add(&element.id, &element.id);
            }
            for child in &element.children {
                if !is_connector(child) {
                    parts.leave_out(child);
                } else if !child.id.is_empty() && !element.id.is_empty() {
                    parts.add(&child.id, &element.id);
                }
            }
            ports.push(PicturePort {
                id: element.id.clone(),
                name: element.name.clone(),
                class: element.kind().to_owned(),
                position: self.pair(element, &about, (["X", "Y"], None)),
            });
        }
        ports
    }

    /// Returns two numbers, or `None` if one is missing, which is a finding if it has a message.
    fn pair(
        &mut self,
        element: &'a CaexElement,
        about: &str,
        (names, missing): ([&str; 2], Option<&str>),
    ) -> Option<[f64; 2]> {
        let is_missing = names.iter().any(|name| element.value(&[name]).is_none());
        if let (true, Some(missing)) = (is_missing, missing) {
            self.find(element, about, missing);
        }
        let [first, second] = names.map(|name| self.number(element, about, name));
        Some([first?, second?])
    }

    /// Returns the width and height, see [`pair`](Self::pair).
    fn size(
        &mut self,
        element: &'a CaexElement,
        about: &str,
        missing: Option<&str>,
    ) -> Option<[f64; 2]> {
        let size = self.pair(element, about, (["Width", "Height"], missing))?;
        if size.iter().any(|one| *one < 0.0) {
            self.find(element, about, "the Width or the Height is below 0");
            return None;
        }
        Some(size)
    }

    fn number(&mut self, element: &'a CaexElement, about: &str, name: &str) -> Option<f64> {
        let text = element.value(&[name])?;
        match number(text) {
            Ok(number) => Some(number),
            Err(fault) => {
                self.find(element, about, &format!("its {name} is `{text}`, {fault}"));
                None
            }
        }
    }
}

impl<'a> PictureParts<'a> {
    /// Adds the ID of a port or of its interface.
    fn add(&mut self, id: &'a str, port: &'a str) {
        self.ports.insert((id, self.picture), port);
    }

    /// Adds an element without a place in the model, with all elements below it, except pictures,
    /// which are read.
    fn leave_out(&mut self, element: &'a CaexElement) {
        if !is_picture(element) {
            self.left_out.extend(parts_of(element));
        }
    }

    /// Returns the ID of the port that a side of a link names, and the index of its picture. A side
    /// is the ID of an interface, or the ID of the port with the name of an interface. The port is
    /// in the picture `at` if that has such a port.
    fn port(&self, side: &str, at: usize) -> Option<(usize, &'a str)> {
        let plain = |id: &str| {
            let own = self.ports.get(&(id, at)).map(|port| (at, *port));
            own.or_else(|| {
                let mut others = self.ports.range((id, 0)..=(id, usize::MAX));
                others.next().map(|((_, picture), port)| (*picture, *port))
            })
        };
        let of_element = || {
            let (id, _) = side.rsplit_once(':')?;
            plain(id).or_else(|| plain(id.strip_prefix('{')?.strip_suffix('}')?))
        };
        plain(side).or_else(of_element)
    }
}

/// The class of an element of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PartClass {
    Picture,
    Group,
    Object { is_topology: bool },
    Connection,
}

impl PartClass {
    fn of(element: &CaexElement) -> Option<Self> {
        if is_picture(element) {
            return Some(Self::Picture);
        }
        let mut parts = element.path.split('/').skip(1);
        parts.find_map(|part| match part {
            "SemanticGroup" => Some(Self::Group),
            "VisualObject" => Some(Self::Object { is_topology: false }),
            "TopologyObject" => Some(Self::Object { is_topology: true }),
            "Connection" => Some(Self::Connection),
            _ => None,
        })
    }
}

/// Returns whether an element is a picture.
pub(crate) fn is_picture(element: &CaexElement) -> bool {
    !element.is_interface && element.kind() == "Picture"
}

/// Returns whether an element of an object or a connection is a port. Some files have ports without
/// a class.
fn is_port(element: &CaexElement) -> bool {
    let is_port = |part| part == "PortObject";
    !element.is_interface
        && (element.path.split('/').any(is_port)
            || (element.path.is_empty() && element.children.iter().any(is_connector)))
}

fn is_connector(element: &CaexElement) -> bool {
    let is_connector = |part| part == "ConnectorInterface";
    element.is_interface && element.path.split('/').any(is_connector)
}

/// Returns an element and all elements below it, without the pictures below it and their elements.
fn parts_of(element: &CaexElement) -> impl Iterator<Item = &CaexElement> {
    let mut waiting = vec![element];
    std::iter::from_fn(move || {
        let next = waiting.pop()?;
        waiting.extend(
            next.children
                .iter()
                .rev()
                .filter(|child| !is_picture(child)),
        );
        Some(next)
    })
}

/// Returns the first characters of the name of a group, which is repeated for each of its parts.
fn shortened(name: &str) -> String {
    name.chars().take(LONGEST_NAME).collect()
}

/// Returns the points of an Edgepath, as `1,2;3,4` with or without an end.
fn points(text: &str) -> Result<Vec<[f64; 2]>, PictureNumberFault> {
    let points = text.split(';').map(str::trim);
    let points = points.filter(|point| !point.is_empty()).map(|point| {
        let (x, y) = point.split_once(',').ok_or(PictureNumberFault::Text)?;
        Ok([number(x)?, number(y)?])
    });
    points.collect()
}

/// Reason for which a number of a picture is not read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
enum PictureNumberFault {
    #[error("which is no number")]
    Text,
    #[error("which is too large or too small for a picture")]
    Magnitude,
}

/// Reads a number: 0, or a number that drawings and statements show in a few characters.
fn number(text: &str) -> Result<f64, PictureNumberFault> {
    let number: f64 = text.trim().parse().map_err(|_| PictureNumberFault::Text)?;
    match number {
        _ if number.is_nan() => Err(PictureNumberFault::Text),
        0.0 => Ok(number),
        _ if MAGNITUDES.contains(&number.abs()) => Ok(number),
        _ => Err(PictureNumberFault::Magnitude),
    }
}

fn text(element: &CaexElement, name: &str) -> String {
    element.value(&[name]).unwrap_or_default().to_owned()
}

/// Limit of the characters of the name of a group.
const LONGEST_NAME: usize = 200;
/// The magnitudes of the numbers of a picture, except 0.
const MAGNITUDES: RangeInclusive<f64> = 1e-6..=1e10;
