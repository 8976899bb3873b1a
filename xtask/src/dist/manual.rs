//! Manual pages from the help texts of the programs.

use std::fmt::Write as _;

use crate::{
    help::{Help, HelpParts},
    links,
};

/// Returns the manual page of a program or verb, in the `man` macros of roff.
pub(crate) fn page(help: &Help, version: &str, date: &str) -> String {
    let parts = help.parts();
    let name = help.words.join("-");
    let mut page = format!(
        ".TH \"{}\" 1 \"{date}\" \"ua-bridge {version}\" \"UA bridge\"\n.SH NAME\n{} \\- {}\n",
        roff(&name.to_uppercase()),
        roff(&name),
        roff(summary(&parts)),
    );
    // Writing to a string does not fail.
    let _written = write!(page, ".SH SYNOPSIS\n.B {}\n", roff(parts.usage));
    if parts.about.len() > 1 || parts.about.concat().len() > summary(&parts).len() + 1 {
        page.push_str(".SH DESCRIPTION\n");
        let paragraphs: Vec<String> = parts.about.iter().map(|text| line(text)).collect();
        page.push_str(&paragraphs.join(".PP\n"));
    }
    for (title, items) in &parts.sections {
        let _written = writeln!(page, ".SH {}", roff(&title.to_uppercase()));
        for item in items {
            let _written = write!(page, ".TP\n.B {}\n", roff(item.head));
            let lines: Vec<String> = item.text.iter().map(|text| line(text)).collect();
            page.push_str(&lines.join(".br\n"));
        }
    }
    let related = related(help);
    if !related.is_empty() {
        let _written = write!(page, ".SH SEE ALSO\n{}\n", related.join(", "));
    }
    page
}

/// Returns the manual page of `ua-bridge`, which names all programs.
pub(crate) fn overview(version: &str, date: &str) -> String {
    let names = links::BRIDGES.into_iter().chain(links::NAMES);
    let related: Vec<String> = names.map(reference).collect();
    format!(
        ".TH \"UA\\-BRIDGE\" 1 \"{date}\" \"ua-bridge {version}\" \"UA bridge\"\n\
         .SH NAME\nua\\-bridge \\- the programs of UA bridge in one file\n\
         .SH SYNOPSIS\n.B ua\\-bridge <PROGRAM> [ARGUMENTS]\n\
         .SH DESCRIPTION\nThe links to this file act as the programs below. The file itself takes the \
         name of a program without ua\\- as its first argument.\n\
         .SH FILES\n.TP\n.I /etc/ua\\-bridge/cell.yaml\nThe mapping of the cell.\n\
         .TP\n.I /etc/ua\\-bridge/environment\nSettings of the services.\n\
         .TP\n.I /var/lib/ua\\-bridge\nCertificates, keys and state of the services.\n\
         .SH SEE ALSO\n{}\n",
        related.join(", ")
    )
}

/// Returns the first sentence, without its full stop.
fn summary<'a>(parts: &HelpParts<'a>) -> &'a str {
    let first = parts.about.first().copied().unwrap_or_default();
    let sentence = first.split(". ").next().unwrap_or(first);
    sentence.trim_end_matches('.')
}

/// Returns the pages of the verbs below, and of the program above.
fn related(help: &Help) -> Vec<String> {
    let name = help.words.join("-");
    let above = help.words.split_last().map(|(_, above)| above.join("-"));
    let above = above.filter(|above| !above.is_empty());
    let below = help
        .verbs()
        .into_iter()
        .map(|verb| format!("{name}-{verb}"));
    above
        .into_iter()
        .chain(below)
        .map(|page| reference(&page))
        .collect()
}

fn reference(page: &str) -> String {
    format!("\\fB{}\\fR(1)", roff(page))
}

/// Returns a line of text, which must not look like a request.
fn line(text: &str) -> String {
    let text = roff(text);
    match text.starts_with(['.', '\'']) {
        true => format!("\\&{text}\n"),
        false => format!("{text}\n"),
    }
}

/// Escapes characters with a meaning in roff. Hyphens stay the character that is typed.
fn roff(text: &str) -> String {
    text.replace('\\', "\\e")
        .replace('-', "\\-")
        .replace('`', "\\(ga")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_has_name_synopsis_and_options() {
        let help = Help {
            words: vec!["ua-tool".to_owned(), "keys".to_owned()],
            text: "Makes keys. Each is random.\n\nUsage: ua-tool keys [OPTIONS]\n\nOptions:\n  \
                   -n, --next  .later\n"
                .to_owned(),
        };
        let page = page(&help, "1.2", "2026-01-02");
        assert_eq!(
            page,
            ".TH \"UA\\-TOOL\\-KEYS\" 1 \"2026-01-02\" \"ua-bridge 1.2\" \"UA bridge\"\n\
             .SH NAME\nua\\-tool\\-keys \\- Makes keys\n\
             .SH SYNOPSIS\n.B ua\\-tool keys [OPTIONS]\n\
             .SH DESCRIPTION\nMakes keys. Each is random.\n\
             .SH OPTIONS\n.TP\n.B \\-n, \\-\\-next\n\\&.later\n\
             .SH SEE ALSO\n\\fBua\\-tool\\fR(1)\n"
        );
    }
}
