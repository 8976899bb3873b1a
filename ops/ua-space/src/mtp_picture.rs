//! `ua-space mtp picture`: lists the pictures of a manifest, or draws a picture as SVG.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write as _};
use std::path::Path;

use ::mtp::{Module, ModulePicture, PictureConnection, PictureObject, PicturePort};
use serde::Serialize;

use crate::arguments::MtpPicture;
use crate::exit::CommandFailure;
use crate::live::{TextTable, harmless, is_coloured, json};

/// Lists the pictures of a manifest, or draws a picture.
pub(crate) fn picture(arguments: &MtpPicture) -> Result<(), CommandFailure> {
    let module = crate::manifest::read(&arguments.file)?;
    let chosen = chosen(&module, arguments.name.as_deref())?;
    if let Some(path) = &arguments.svg {
        return draw(&module, &chosen, path);
    }
    let mut out = io::stdout().lock();
    if arguments.json {
        let rows: Vec<PictureRow<'_>> = chosen
            .iter()
            .map(|picture| PictureRow::of(&module, picture))
            .collect();
        writeln!(out, "{}", json(&rows)?)?;
        return Ok(());
    }
    let columns = ["PICTURE", "NAME", "CLASS", "X,Y", "SIZE", "SHOWS", "JOINS"];
    let mut table = TextTable::new(columns.map(str::to_owned));
    for picture in chosen {
        let picture = PictureRow::of(&module, picture);
        table.row([
            picture.name.to_owned(),
            String::new(),
            "Picture".to_owned(),
            String::new(),
            pair(picture.size, "x"),
            String::new(),
            String::new(),
        ]);
        for object in &picture.objects {
            table.row([
                picture.name.to_owned(),
                object.name.to_owned(),
                object.class.to_owned(),
                pair(object.position, ","),
                pair(object.size, "x"),
                object.shows.unwrap_or_default().to_owned(),
                object.joins.join(", "),
            ]);
        }
        for connection in &picture.connections {
            table.row([
                picture.name.to_owned(),
                connection.name.to_owned(),
                connection.class.to_owned(),
                pair(connection.path.first().copied(), ","),
                String::new(),
                String::new(),
                connection.joins.join(", "),
            ]);
        }
    }
    table.write(&mut out, is_coloured())?;
    Ok(())
}

/// Returns the pictures with a name or an ID, or all.
fn chosen<'m>(
    module: &'m Module,
    name: Option<&str>,
) -> Result<Vec<&'m ModulePicture>, CommandFailure> {
    let is_chosen =
        |one: &&ModulePicture| name.is_none_or(|name| one.name == name || one.id == name);
    let found: Vec<&ModulePicture> = module.pictures.iter().filter(is_chosen).collect();
    match name {
        Some(name) if found.is_empty() => Err(CommandFailure::Usage(format!(
            "the manifest has no picture `{}`; {}",
            harmless(name),
            names(&module.pictures)
        ))),
        _ => Ok(found),
    }
}

/// Returns the sentence with the names and the IDs of pictures.
fn names<'m>(pictures: impl IntoIterator<Item = &'m ModulePicture>) -> String {
    let mut pictures = pictures.into_iter();
    let shown = pictures.by_ref().take(SHOWN);
    let shown = shown.map(|one| format!("{} ({})", harmless(&one.name), harmless(&one.id)));
    let shown: Vec<String> = shown.collect();
    let shown = shown.join(", ");
    match (shown.is_empty(), pictures.count()) {
        (true, _) => "it has no pictures".to_owned(),
        (false, 0) => format!("its pictures are {shown}"),
        (false, 1) => format!("its pictures are {shown} and 1 other"),
        (false, others) => format!("its pictures are {shown} and {others} others"),
    }
}

/// Writes the drawing of the only chosen picture, or of the only one that is not empty.
fn draw(module: &Module, chosen: &[&ModulePicture], path: &Path) -> Result<(), CommandFailure> {
    let filled: Vec<&ModulePicture> = chosen
        .iter()
        .copied()
        .filter(|one| !one.objects.is_empty() || !one.connections.is_empty())
        .collect();
    let picture = match (chosen, &*filled) {
        ([only], _) | (_, [only]) => only,
        ([], _) => {
            let why = "the manifest has no pictures to draw";
            return Err(CommandFailure::Data(why.to_owned()));
        }
        _ => {
            return Err(CommandFailure::Usage(format!(
                "choose the picture to draw by its name or its ID: {}",
                names(chosen.iter().copied())
            )));
        }
    };
    let drawing = picture.svg(&module.assemblies);
    let written = File::create_new(path).and_then(|mut to| to.write_all(drawing.as_bytes()));
    written.map_err(|error| CommandFailure::Io(format!("cannot write {}: {error}", path.display())))
}

/// A picture.
#[derive(Debug, Serialize)]
struct PictureRow<'m> {
    id: &'m str,
    name: &'m str,
    level: &'m str,
    size: Option<[f64; 2]>,
    objects: Vec<PictureObjectRow<'m>>,
    connections: Vec<PictureConnectionRow<'m>>,
}

#[derive(Debug, Serialize)]
struct PictureObjectRow<'m> {
    id: &'m str,
    name: &'m str,
    class: &'m str,
    group: &'m str,
    position: Option<[f64; 2]>,
    size: Option<[f64; 2]>,
    rotation: f64,
    layer: f64,
    view: &'m str,
    eclass: &'m str,
    eclass_version: &'m str,
    eclass_irdi: &'m str,
    /// The name of its data assembly.
    shows: Option<&'m str>,
    assembly: Option<&'m str>,
    joins: Vec<&'m str>,
    ports: Vec<PicturePortRow<'m>>,
}

#[derive(Debug, Serialize)]
struct PictureConnectionRow<'m> {
    id: &'m str,
    name: &'m str,
    class: &'m str,
    group: &'m str,
    path: &'m [[f64; 2]],
    layer: f64,
    is_directed: bool,
    joins: Vec<&'m str>,
    ports: Vec<PicturePortRow<'m>>,
}

#[derive(Debug, Serialize)]
struct PicturePortRow<'m> {
    id: &'m str,
    name: &'m str,
    class: &'m str,
    position: Option<[f64; 2]>,
}

/// The neighbours of the parts of a picture, see [`ModulePicture::neighbours`].
type Neighbours<'m> = BTreeMap<&'m str, BTreeMap<&'m str, &'m str>>;

impl<'m> PictureRow<'m> {
    fn of(module: &'m Module, picture: &'m ModulePicture) -> Self {
        let assemblies = module.assemblies.iter();
        let assemblies: BTreeMap<&str, &str> =
            assemblies.map(|one| (&*one.id, &*one.name)).collect();
        let neighbours = picture.neighbours();
        let objects = picture.objects.iter();
        let connections = picture.connections.iter();
        Self {
            id: &picture.id,
            name: &picture.name,
            level: &picture.level,
            size: picture.size,
            objects: objects
                .map(|one| PictureObjectRow::of(one, &neighbours, &assemblies))
                .collect(),
            connections: connections
                .map(|one| PictureConnectionRow::of(one, &neighbours))
                .collect(),
        }
    }
}

impl<'m> PictureObjectRow<'m> {
    fn of(
        object: &'m PictureObject,
        neighbours: &Neighbours<'m>,
        assemblies: &BTreeMap<&'m str, &'m str>,
    ) -> Self {
        let assembly = object.assembly.as_deref();
        Self {
            id: &object.id,
            name: &object.name,
            class: &object.class,
            group: &object.group,
            position: object.position,
            size: object.size,
            rotation: object.rotation,
            layer: object.layer,
            view: &object.view,
            eclass: &object.eclass,
            eclass_version: &object.eclass_version,
            eclass_irdi: &object.eclass_irdi,
            shows: assembly.and_then(|id| assemblies.get(id).copied()),
            assembly,
            joins: joins(neighbours, &object.id),
            ports: ports(&object.ports),
        }
    }
}

impl<'m> PictureConnectionRow<'m> {
    fn of(connection: &'m PictureConnection, neighbours: &Neighbours<'m>) -> Self {
        Self {
            id: &connection.id,
            name: &connection.name,
            class: &connection.class,
            group: &connection.group,
            path: &connection.path,
            layer: connection.layer,
            is_directed: connection.is_directed,
            joins: joins(neighbours, &connection.id),
            ports: ports(&connection.ports),
        }
    }
}

/// Returns the sorted names of the neighbours of a part.
fn joins<'m>(neighbours: &Neighbours<'m>, id: &str) -> Vec<&'m str> {
    let found = neighbours.get(id).into_iter().flatten();
    let mut names: Vec<&str> = found.map(|(_, name)| *name).collect();
    names.sort_unstable();
    names
}

fn ports(ports: &[PicturePort]) -> Vec<PicturePortRow<'_>> {
    let rows = ports.iter().map(|port| PicturePortRow {
        id: &port.id,
        name: &port.name,
        class: &port.class,
        position: port.position,
    });
    rows.collect()
}

fn pair(numbers: Option<[f64; 2]>, between: &str) -> String {
    numbers.map_or_else(String::new, |[first, second]| {
        format!("{first}{between}{second}")
    })
}

/// Maximum number of pictures in a message.
const SHOWN: usize = 20;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::manifest::column;

    #[test]
    fn the_message_has_twenty_pictures_and_the_number_of_the_others() {
        let picture = &column().pictures[0];
        let of = |number: usize| names(std::iter::repeat_n(picture, number));
        let twenty = of(20);
        assert_eq!(twenty.matches("Overview (pic)").count(), 20);
        assert!(twenty.ends_with(", Overview (pic)"), "{twenty}");
        assert_eq!(of(21), format!("{twenty} and 1 other"));
        assert_eq!(of(27), format!("{twenty} and 7 others"));
        assert_eq!(of(0), "it has no pictures");
    }

    /// Returns the failure of drawing a picture into a folder that does not exist.
    fn failure(module: &Module, name: Option<&str>) -> String {
        let path = Path::new("/nowhere/picture.svg");
        let drawn = chosen(module, name).and_then(|chosen| draw(module, &chosen, path));
        drawn.unwrap_err().to_string()
    }

    #[test]
    fn an_object_is_listed_with_its_data_assembly_and_its_neighbours() {
        let module = column();
        let row = PictureRow::of(&module, &module.pictures[0]);
        let heater = &row.objects[0];
        assert_eq!((heater.name, heater.shows), ("Heater", Some("Heater")));
        assert_eq!(heater.joins, ["Pipe", "Signal"]);
        assert_eq!(row.connections[0].joins, ["Feed", "Heater"]);
        assert_eq!(pair(heater.size, "x"), "60x90");
    }

    #[test]
    fn the_only_picture_with_contents_is_drawn_and_others_need_a_name() {
        let mut module = column();
        let mut other = module.pictures[0].clone();
        other.name = "Other".to_owned();
        other.id = "other".to_owned();
        let mut empty = other.clone();
        empty.objects.clear();
        empty.connections.clear();
        module.pictures.push(empty);
        assert!(failure(&module, None).starts_with("cannot write /nowhere/picture.svg"));
        module.pictures[1] = other;
        assert_eq!(
            failure(&module, None),
            "choose the picture to draw by its name or its ID: its pictures are \
             Overview (pic), Other (other)"
        );
        assert!(failure(&module, Some("other")).starts_with("cannot write"));
        assert_eq!(
            failure(&module, Some("Detail")),
            "the manifest has no picture `Detail`; its pictures are Overview (pic), Other (other)"
        );
        // A picture with objects only, or with connections only, is not empty.
        module.pictures[1].connections.clear();
        assert!(failure(&module, None).starts_with("choose"));
        module.pictures[1].connections = module.pictures[0].connections.clone();
        module.pictures[1].objects.clear();
        assert!(failure(&module, None).starts_with("choose"));
        module.pictures.clear();
        assert_eq!(
            failure(&module, None),
            "the manifest has no pictures to draw"
        );
    }
}
