//! The pictures of modules for operators: their list, and their drawings. Both are made from the
//! statements of the graph, so that they outlast the file of the manifest.

use std::sync::Arc;

use bytes::Bytes;
use http_body_util::Full;
use hyper::header::{CONTENT_SECURITY_POLICY, HeaderValue, X_CONTENT_TYPE_OPTIONS};
use hyper::{Response, StatusCode};
use mtp::{DataAssembly, Family, ModulePicture, PictureConnection, PictureObject};
use oxigraph::model::{GraphNameRef, NamedNodeRef, Term};
use oxigraph::store::Store;
use serde::Serialize;
use serde_json::json;
use thiserror::Error;
use uri_text::unescaped;

use crate::http::{HttpRefusal, ServedSite, content, json_page};
use crate::lanes::Lane;
use crate::store::Knowledge;
use crate::vocabulary as v;
use crate::writes::failed;

/// A picture of a module.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct ListedPicture {
    /// The name of the module.
    pub module_name: String,
    /// The name of the picture.
    pub name: String,
    /// The IRI of the module.
    pub module: String,
    /// The IRI of the picture.
    pub picture: String,
    /// Number of its objects and connections.
    pub parts: usize,
}

/// Reason for which there is no drawing or no list.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum PictureFault {
    /// The graph has no such module.
    #[error("there is no module `{0}`; the question `components` lists the modules")]
    UnknownModule(String),
    /// The graph has no such picture.
    #[error("there is no picture `{0}`; /pictures lists the pictures")]
    UnknownPicture(String),
    /// The drawing would be too large.
    #[error(
        "the picture `{picture}` has more than {} parts or {} MiB; draw it with ua-space mtp picture",
        Knowledge::MOST_PICTURE_PARTS,
        Knowledge::LARGEST_PICTURE >> 20
    )]
    TooLarge {
        /// The IRI of the picture.
        picture: String,
    },
}

impl Knowledge {
    /// Maximum number of pictures in a list.
    pub const MOST_PICTURES: usize = 1000;
    /// Maximum number of objects and connections of a drawing.
    pub const MOST_PICTURE_PARTS: usize = 10_000;
    /// Maximum size of a drawing in bytes.
    pub const LARGEST_PICTURE: usize = 4 << 20;

    /// Lists the pictures of all modules, or of the module with this IRI: the first
    /// [`MOST_PICTURES`](Self::MOST_PICTURES), in the order of their names.
    ///
    /// # Errors
    /// [`PictureFault::UnknownModule`].
    pub fn pictures(&self, module: Option<&str>) -> Result<Vec<ListedPicture>, PictureFault> {
        let graph = PictureStatements {
            store: self.store(),
        };
        if let Some(module) = module
            && !graph.is_a(module, v::MODULE)
        {
            return Err(PictureFault::UnknownModule(shown(module)));
        }
        let mut found = Vec::new();
        for (of, picture) in graph.with(module, v::HAS_PICTURE).take(MOST_SEEN) {
            if !graph.is_a(&picture, v::PICTURE) {
                continue;
            }
            found.push(ListedPicture {
                module_name: shown(&graph.name(&of)),
                name: shown(&graph.name(&picture)),
                parts: graph.objects(&picture, v::HAS_PICTURE_PART).count(),
                module: of,
                picture,
            });
        }
        found.sort();
        found.truncate(Self::MOST_PICTURES);
        Ok(found)
    }

    /// Draws the picture with this IRI as SVG, like [`ModulePicture::svg`].
    ///
    /// # Errors
    /// [`PictureFault`].
    pub fn picture_svg(&self, picture: &str) -> Result<String, PictureFault> {
        let changes = self.changes();
        let mut before = *changes.borrow();
        let mut drawn = self.drawn(picture);
        // A manifest that is replaced meanwhile has parts of both files.
        for _ in 0..DRAWN_AGAIN {
            let after = *changes.borrow();
            if after == before {
                break;
            }
            before = after;
            drawn = self.drawn(picture);
        }
        drawn
    }

    fn drawn(&self, iri: &str) -> Result<String, PictureFault> {
        let graph = PictureStatements {
            store: self.store(),
        };
        if !graph.is_a(iri, v::PICTURE) {
            return Err(PictureFault::UnknownPicture(shown(iri)));
        }
        let too_large = || PictureFault::TooLarge {
            picture: shown(iri),
        };
        let mut parts = Vec::new();
        for part in graph.objects(iri, v::HAS_PICTURE_PART) {
            let Term::NamedNode(part) = part else {
                continue;
            };
            if parts.len() >= Self::MOST_PICTURE_PARTS {
                return Err(too_large());
            }
            let position = graph.number(part.as_str(), v::POSITION);
            parts.push((position.unwrap_or_default(), part.into_string()));
        }
        parts.sort_by(|one, other| one.0.total_cmp(&other.0).then_with(|| one.1.cmp(&other.1)));
        let mut drawing = DrawnPicture::new(graph.picture(iri));
        for (_, part) in parts {
            drawing.add(&graph, &part);
            // Bounds the memory before the picture is drawn.
            if drawing.texts > Self::LARGEST_PICTURE {
                return Err(too_large());
            }
        }
        let svg = drawing.picture.svg(&drawing.assemblies);
        if svg.len() > Self::LARGEST_PICTURE {
            return Err(too_large());
        }
        Ok(svg)
    }
}

impl ServedSite {
    /// Answers with the list of the pictures of all modules, or of the module of `?module=IRI`.
    pub(crate) async fn pictures(
        &self,
        pairs: &[(String, String)],
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        let module = pairs.iter().find(|(key, _)| key == "module");
        let module = module.map(|(_, module)| module.clone());
        let found = self.read_pictures(move |all| all.pictures(module.as_deref()));
        let found = found.await?;
        Ok(json_page(&json!({ "pictures": found })))
    }

    /// Answers with the drawing of the picture whose escaped IRI is in the path.
    pub(crate) async fn picture(&self, iri: &str) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        let iri = unescaped(iri)
            .ok_or_else(|| HttpRefusal::malformed("the IRI is not escaped as %XX of UTF-8"))?;
        let svg = self.read_pictures(move |all| all.picture_svg(&iri)).await?;
        let mut response = content("image/svg+xml", svg.into_bytes());
        // A browser that opens the drawing itself runs nothing that a name may contain.
        let headers = response.headers_mut();
        let policy = "default-src 'none'; style-src 'unsafe-inline'; sandbox";
        headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(policy));
        let sniffing = HeaderValue::from_static("nosniff");
        headers.insert(X_CONTENT_TYPE_OPTIONS, sniffing);
        Ok(response)
    }

    /// Reads pictures on a thread of its own, in the place of a named question.
    async fn read_pictures<T: Send + 'static>(
        &self,
        read: impl FnOnce(&Knowledge) -> Result<T, PictureFault> + Send + 'static,
    ) -> Result<T, HttpRefusal> {
        let place = self.queries.place(Lane::Named).await?;
        let knowledge = Arc::clone(self.queries.knowledge());
        let done = tokio::task::spawn_blocking(move || {
            let _place = place;
            read(&knowledge)
        });
        Ok(done.await.map_err(|error| failed(&error))??)
    }
}

impl From<PictureFault> for HttpRefusal {
    fn from(fault: PictureFault) -> Self {
        match &fault {
            PictureFault::UnknownModule(_) | PictureFault::UnknownPicture(_) => {
                Self::unknown(fault.to_string())
            }
            PictureFault::TooLarge { .. } => {
                let status = StatusCode::INSUFFICIENT_STORAGE;
                Self::new(status, "result_limit", &fault.to_string())
            }
        }
    }
}

/// A picture while it is read, with the names of the elements that its objects show.
struct DrawnPicture {
    picture: ModulePicture,
    assemblies: Vec<DataAssembly>,
    /// Number of bytes of its texts.
    texts: usize,
}

impl DrawnPicture {
    const fn new(picture: ModulePicture) -> Self {
        Self {
            picture,
            assemblies: Vec::new(),
            texts: 0,
        }
    }

    fn add(&mut self, graph: &PictureStatements, part: &str) {
        if graph.is_a(part, v::PICTURE_CONNECTION) {
            let path = graph.text(part, v::EDGE_PATH);
            let connection = PictureConnection {
                id: part.to_owned(),
                name: graph.name(part),
                class: graph.text(part, v::ELEMENT_KIND),
                group: String::new(),
                path: PictureConnection::points(&path).unwrap_or_default(),
                layer: graph.number(part, v::LAYER).unwrap_or_default(),
                is_directed: graph.is_true(part, v::IS_DIRECTED),
                ports: Vec::new(),
            };
            self.texts += connection.name.len() + connection.class.len() + path.len();
            self.picture.connections.push(connection);
            return;
        }
        let pair = |first, second| Some([graph.number(part, first)?, graph.number(part, second)?]);
        let elements = graph.objects(part, v::SHOWS_ELEMENT);
        let mut elements = elements.filter_map(|element| match element {
            Term::NamedNode(element) => Some(element.into_string()),
            Term::BlankNode(_) | Term::Literal(_) => None,
        });
        let element = elements.next();
        if let Some(assembly) = element.as_ref().and_then(|element| graph.assembly(element)) {
            self.texts += assembly.name.len() + assembly.kind.len();
            self.assemblies.push(assembly);
        }
        let object = PictureObject {
            id: part.to_owned(),
            name: graph.name(part),
            class: graph.text(part, v::ELEMENT_KIND),
            is_topology: graph.is_true(part, v::IS_TOPOLOGY),
            group: String::new(),
            position: pair(v::LEFT, v::TOP),
            size: pair(v::WIDTH, v::HEIGHT),
            rotation: 0.0,
            layer: graph.number(part, v::LAYER).unwrap_or_default(),
            view: String::new(),
            eclass: String::new(),
            eclass_version: String::new(),
            eclass_irdi: String::new(),
            assembly: element,
            ports: Vec::new(),
        };
        self.texts += object.name.len() + object.class.len();
        self.picture.objects.push(object);
    }
}

/// The statements of all sources about pictures.
struct PictureStatements {
    store: Store,
}

impl PictureStatements {
    /// Returns the subjects and objects of a predicate that are IRIs; of one subject, if it is
    /// given.
    fn with(
        &self,
        subject: Option<&str>,
        predicate: &str,
    ) -> impl Iterator<Item = (String, String)> + use<> {
        let predicate = NamedNodeRef::new_unchecked(predicate);
        let quads = self.store.quads_for_pattern(
            subject.map(|subject| NamedNodeRef::new_unchecked(subject).into()),
            Some(predicate),
            None,
            Some(GraphNameRef::DefaultGraph),
        );
        quads.flatten().filter_map(|quad| {
            let (subject, object) = (quad.subject, quad.object);
            match (subject.into(), object) {
                (Term::NamedNode(subject), Term::NamedNode(object)) => {
                    Some((subject.into_string(), object.into_string()))
                }
                (Term::NamedNode(_) | Term::BlankNode(_) | Term::Literal(_), _) => None,
            }
        })
    }

    /// Returns the objects of statements; none if the subject is no IRI.
    fn objects(&self, subject: &str, predicate: &str) -> impl Iterator<Item = Term> + use<> {
        let quads = NamedNodeRef::new(subject).ok().map(|subject| {
            self.store.quads_for_pattern(
                Some(subject.into()),
                Some(NamedNodeRef::new_unchecked(predicate)),
                None,
                Some(GraphNameRef::DefaultGraph),
            )
        });
        quads
            .into_iter()
            .flatten()
            .flatten()
            .map(|quad| quad.object)
    }

    fn is_a(&self, subject: &str, class: &str) -> bool {
        let mut classes = self.objects(subject, v::RDF_TYPE);
        classes.any(|of| matches!(of, Term::NamedNode(of) if of.as_str() == class))
    }

    /// Returns the first text; empty if there is none.
    fn text(&self, subject: &str, predicate: &str) -> String {
        let mut texts = self.objects(subject, predicate).filter_map(literal);
        texts.next().unwrap_or_default()
    }

    fn name(&self, subject: &str) -> String {
        self.text(subject, v::RDFS_LABEL)
    }

    /// Returns the first finite number.
    fn number(&self, subject: &str, predicate: &str) -> Option<f64> {
        let texts = self.objects(subject, predicate).filter_map(literal);
        let mut numbers = texts.filter_map(|text| text.parse::<f64>().ok());
        numbers.find(|number| number.is_finite())
    }

    fn is_true(&self, subject: &str, predicate: &str) -> bool {
        self.text(subject, predicate) == "true"
    }

    /// Returns a picture without its parts.
    fn picture(&self, iri: &str) -> ModulePicture {
        let size = [v::WIDTH, v::HEIGHT].map(|length| self.number(iri, length));
        let size = match size {
            [Some(width), Some(height)] => Some([width, height]),
            _ => None,
        };
        ModulePicture {
            id: iri.to_owned(),
            name: self.name(iri),
            level: String::new(),
            size,
            objects: Vec::new(),
            connections: Vec::new(),
            links: Vec::new(),
        }
    }

    /// Returns the name and the kind of an element, if the graph has them.
    fn assembly(&self, element: &str) -> Option<DataAssembly> {
        let name = self.name(element);
        (!name.is_empty()).then(|| DataAssembly {
            id: element.to_owned(),
            name,
            kind: self.text(element, v::ELEMENT_KIND),
            family: Family::Other,
            variables: Vec::new(),
        })
    }
}

fn literal(term: Term) -> Option<String> {
    match term {
        Term::Literal(literal) => Some(literal.destruct().0),
        Term::NamedNode(_) | Term::BlankNode(_) => None,
    }
}

/// Returns the first characters of an IRI or a name, for a list or a message.
fn shown(text: &str) -> String {
    text.chars().take(SHOWN).collect()
}

/// Maximum number of statements that a list is made of.
const MOST_SEEN: usize = 10_000;
/// Number of attempts to draw a picture whose manifest is replaced meanwhile.
const DRAWN_AGAIN: usize = 2;
const SHOWN: usize = 200;
