//! Errors in a document, formatted like errors of rustc: code, location, the line with a caret, and
//! help.

use documents::{Excerpt, SourceSpan as Place, finding_codes};

finding_codes! {
    /// The kind of a finding. The meaning of a code is stable across releases; codes may be added.
    YamlFindingCode {
        Syntax = "P001", "The text is not YAML, or uses what is not read here: several documents, tags, aliases. Nothing after the place has been looked at.";
        TooLarge = "P002", "The document passes a limit: 1 MiB, 20 000 values, 16 levels of nesting.";
        UnknownKey = "P003", "No key of that name is read at this place. Keys are spelt in lower case with underscores.";
        DuplicateKey = "P004", "A key occurs twice in one map.";
        WrongValue = "P005", "The value is not what its key takes: a list, a map, a number of a range, or one of a few words.";
        MissingKey = "P006", "A key that has no default is not there.";
        Name = "P010", "A name has letters, digits, - and _ only, at most 64 of them: it stands in the names of the space.";
        NameTwice = "P011", "Two skills or two values of a component have one name.";
        Uri = "P012", "A URI has a scheme, as urn:example:gripper or https://example.com/grasp, and no blanks.";
        Namespace = "P013", "The namespace is the number of the component in the space of the cell, from 1 to 65535, and of no other program.";
        Endpoint = "P014", "An endpoint is opc.tcp://<host>:<port>[/path].";
        Duration = "P015", "A duration is a number with its unit, as 400 ms, 2.5 s or 10 min.";
        NodeSet = "P016", "A NodeSet is a file in the form of OPC 10000-6, annex F, beside the document or by its path.";
        SkillType = "P020", "A skill type is one of urn:ua-bridge:skills by its name, or nsu=<namespace uri>;<BrowseName> of one that a NodeSet brings, and a subtype of SkillType.";
        AbstractType = "P021", "An abstract type has no skills of its own, only its subtypes have.";
        Driver = "P022", "Who does the work of a skill: `simulated` for grippers and robots, `device` for what `device` of the component names, `pick_and_place` for PickAndPlaceSkillType, `call` and `action` for what others in the space do.";
        TooMany = "P023", "A component has from 1 to 1000 skills, and at most 89 values. A component with values needs no skills.";
        Capability = "P024", "A capability is the IRI of its class in the plant's knowledge.";
        Source = "P025", "A value has one source: `device` with the name of a value of the component's device, `modbus`, `io_link`, `http`, `topic` for a topic of the space, `exec` for a program, or the runs of a skill as `runs`, `failures`, `mean_duration` or `availability`.";
    }
}

/// A finding. Each is an error: the document cannot be used with it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct YamlFinding {
    /// The kind.
    pub code: YamlFindingCode,
    /// The location in the text.
    pub place: Place,
    /// The error, with the invalid value.
    pub message: String,
    /// How to correct it.
    pub help: Option<String>,
}

impl YamlFinding {
    /// Creates an error.
    pub fn error(code: YamlFindingCode, place: Place, message: impl Into<String>) -> Self {
        Self {
            code,
            place,
            message: message.into(),
            help: None,
        }
    }

    /// Adds how to correct it.
    #[must_use]
    pub fn with_help(mut self, help: impl Into<String>) -> Self {
        self.help = Some(help.into());
        self
    }

    /// Returns the finding with its source line, as several lines that end with a newline. Control
    /// characters of the source are replaced, so that a document cannot control the terminal.
    #[must_use]
    pub fn render(&self, file: &str, source: &str) -> String {
        let excerpt = Excerpt {
            severity: "error",
            code: self.code.as_str(),
            message: &self.message,
            file,
            span: self.place,
            label: None,
            help: self.help.as_deref(),
        };
        excerpt.render(source, str::to_owned)
    }
}

/// The findings of a document.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Findings {
    found: Vec<YamlFinding>,
    left_out: usize,
}

impl Findings {
    /// Adds a finding. After the first 200, further findings are only counted.
    pub fn push(&mut self, finding: YamlFinding) {
        if self.found.len() >= MOST {
            self.left_out += 1;
        } else if !self.found.contains(&finding) {
            self.found.push(finding);
        }
    }

    /// Adds an error.
    pub fn error(&mut self, code: YamlFindingCode, place: Place, message: impl Into<String>) {
        self.push(YamlFinding::error(code, place, message));
    }

    /// Adds an error and how to correct it.
    pub fn error_with(
        &mut self,
        code: YamlFindingCode,
        place: Place,
        message: impl Into<String>,
        help: impl Into<String>,
    ) {
        self.push(YamlFinding::error(code, place, message).with_help(help));
    }

    /// Returns whether there are no findings.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.found.is_empty()
    }

    /// Returns the number of findings.
    #[must_use]
    pub fn len(&self) -> usize {
        self.found.len() + self.left_out
    }

    /// Returns the findings in the order of the text.
    #[must_use]
    pub fn sorted(mut self) -> Vec<YamlFinding> {
        self.found
            .sort_by_key(|finding| (finding.place, finding.code));
        if self.left_out > 0 {
            let message = format!("{} more findings are not shown", self.left_out);
            self.found.push(YamlFinding::error(
                YamlFindingCode::TooLarge,
                Place::START,
                message,
            ));
        }
        self.found
    }

    /// Returns all findings as text for people, each followed by a blank line.
    #[must_use]
    pub fn render(self, file: &str, source: &str) -> String {
        self.sorted()
            .iter()
            .map(|finding| finding.render(file, source) + "\n")
            .collect()
    }
}

impl Extend<YamlFinding> for Findings {
    fn extend<I: IntoIterator<Item = YamlFinding>>(&mut self, findings: I) {
        findings.into_iter().for_each(|finding| self.push(finding));
    }
}

const MOST: usize = 200;
