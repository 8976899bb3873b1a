//! Statements about the pictures of a module.

use std::collections::BTreeMap;

use crate::picture::{ModulePicture, PictureConnection, PictureObject};
use crate::rdf::{ModuleStatements, Object};
use crate::vocabulary as v;

impl ModuleStatements<'_> {
    /// Adds a picture with its parts, and which of them are joined.
    pub(crate) fn picture(&mut self, module: &str, picture: &ModulePicture) {
        let iri = self.name(module, "picture", &picture.id, &picture.name);
        self.link(module, v::HAS_PICTURE, &iri);
        self.is_a(&iri, &[v::PICTURE]);
        self.text(&iri, v::RDFS_LABEL, &picture.name);
        self.numbers(&iri, [v::WIDTH, v::HEIGHT], picture.size);
        let mut parts: BTreeMap<&str, String> = BTreeMap::new();
        for (object, position) in picture.objects.iter().zip(1..) {
            let part = self.picture_object(&iri, object);
            self.order(&part, (object.layer, position));
            parts.insert(&object.id, part);
        }
        for (connection, position) in picture.connections.iter().zip(1..) {
            let part = self.picture_connection(&iri, connection);
            self.order(&part, (connection.layer, position));
            parts.insert(&connection.id, part);
        }
        for (id, neighbours) in picture.neighbours() {
            let Some(part) = parts.get(id) else { continue };
            for neighbour in neighbours.keys().filter_map(|id| parts.get(id)) {
                self.link(part, v::IS_JOINED_WITH, neighbour);
            }
        }
    }

    fn picture_object(&mut self, picture: &str, object: &PictureObject) -> String {
        let iri = self.name(picture, "object", &object.id, &object.name);
        self.link(picture, v::HAS_PICTURE_PART, &iri);
        self.is_a(&iri, &[v::PICTURE_OBJECT]);
        self.text(&iri, v::RDFS_LABEL, &object.name);
        self.text(&iri, v::ELEMENT_KIND, &object.class);
        self.numbers(&iri, [v::LEFT, v::TOP], object.position);
        self.numbers(&iri, [v::WIDTH, v::HEIGHT], object.size);
        self.say(&iri, v::ROTATION, Object::Number(object.rotation));
        for (predicate, text) in [
            (v::SEMANTIC_GROUP, &object.group),
            (v::ECLASS, &object.eclass),
        ] {
            if !text.is_empty() {
                self.text(&iri, predicate, text);
            }
        }
        if object.is_topology {
            self.say(&iri, v::IS_TOPOLOGY, Object::Boolean(true));
        }
        if let Some(assembly) = &object.assembly {
            let element = self.element_iri(assembly);
            self.link(&iri, v::SHOWS_ELEMENT, &element);
        }
        iri
    }

    fn picture_connection(&mut self, picture: &str, connection: &PictureConnection) -> String {
        let iri = self.name(picture, "connection", &connection.id, &connection.name);
        self.link(picture, v::HAS_PICTURE_PART, &iri);
        self.is_a(&iri, &[v::PICTURE_CONNECTION]);
        self.text(&iri, v::RDFS_LABEL, &connection.name);
        self.text(&iri, v::ELEMENT_KIND, &connection.class);
        let points = connection.path.iter().map(|[x, y]| format!("{x},{y}"));
        let path: Vec<String> = points.collect();
        self.text(&iri, v::EDGE_PATH, &path.join(";"));
        if connection.is_directed {
            self.say(&iri, v::IS_DIRECTED, Object::Boolean(true));
        }
        if !connection.group.is_empty() {
            self.text(&iri, v::SEMANTIC_GROUP, &connection.group);
        }
        iri
    }

    /// Adds the layer of a part, and its position in the file, which order the parts of a drawing.
    fn order(&mut self, part: &str, (layer, position): (f64, i64)) {
        self.say(part, v::LAYER, Object::Number(layer));
        self.say(part, v::POSITION, Object::Integer(position));
    }

    fn numbers(&mut self, of: &str, predicates: [&str; 2], numbers: Option<[f64; 2]>) {
        for (predicate, number) in predicates.into_iter().zip(numbers.into_iter().flatten()) {
            self.say(of, predicate, Object::Number(number));
        }
    }
}
