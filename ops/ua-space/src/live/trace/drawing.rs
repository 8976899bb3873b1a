//! A drawing of the delays: the hops of each topic as a waterfall, and their distribution.

use std::fmt::Write as _;

use mappings::TopicId;
use xml_text::xml_printable;

use super::super::text::{harmless, micros};
use super::{DelayWindow, Delays, Topic};
use crate::cell::HopPage;

/// Returns the drawing of the topics with the longest delays.
pub(super) fn svg(delays: &Delays, name_of: &dyn Fn(TopicId) -> Option<String>) -> String {
    let mut topics: Vec<(String, &Topic)> = delays
        .topics
        .iter()
        .filter(|(_, topic)| topic.network.count() > 0)
        .map(|(topic, of)| {
            let name = name_of(*topic).unwrap_or_else(|| topic.to_string());
            (harmless(&name), of)
        })
        .collect();
    let total = |topic: &Topic| median(&topic.origin) + median(&topic.network);
    topics.sort_by(|(_, one), (_, other)| total(other).total_cmp(&total(one)));
    let left_out = topics.len().saturating_sub(MOST_TOPICS);
    topics.truncate(MOST_TOPICS);
    let longest = topics.iter().map(|(_, topic)| total(topic));
    let longest = longest.fold(1.0_f64, f64::max);
    let height = HEAD + ROW * count(topics.len()) + FOOT;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" width=\"{WIDTH}\" \
         height=\"{height}\" font-family=\"sans-serif\" font-size=\"12\">\n<style>\
         svg{{background:#fff;color:#17212b}}text{{fill:#17212b}}.o{{fill:#9fd3cd}}.n{{fill:#0f766e}}\
         .m{{fill:#586674}}.l{{stroke:#dde3e9}}@media(prefers-color-scheme:dark){{svg{{background:#0f1418}}\
         text{{fill:#e4eaef}}.o{{fill:#1d5f58}}.n{{fill:#2dd4bf}}.m{{fill:#9aa8b4}}.l{{stroke:#2a343d}}}}\
         </style>\n<title>Delays of topics, hop by hop</title>\n"
    );
    let mut text = |x: f64, y: f64, class: &str, anchor: &str, text: &str| {
        let text = xml_printable(text);
        // Writing to a String cannot fail.
        let _written = writeln!(
            svg,
            "<text x=\"{x:.1}\" y=\"{y:.1}\" class=\"{class}\" text-anchor=\"{anchor}\">{text}</text>"
        );
    };
    text(LEFT, 20.0, "", "start", "Median: origin, then network");
    text(
        RIGHT,
        20.0,
        "",
        "start",
        "Distribution of the network, 1 us to 1 s",
    );
    for (at, (name, topic)) in topics.iter().enumerate() {
        let y = HEAD + ROW * count(at);
        text(LEFT - 10.0, y + 20.0, "", "end", &abbreviated(name));
        let [origin, network] = [&topic.origin, &topic.network].map(delays_of);
        let p99 = shown(network.as_ref().map(|hop| hop.p99_us));
        let [origin, network] = [origin, network].map(|hop| shown(hop.map(|hop| hop.p50_us)));
        let label = format!("{origin} + {network}");
        text(LEFT, y + 38.0, "m", "start", &label);
        let samples = format!("p99 {p99}, {} samples", topic.network.count());
        text(RIGHT, y + 44.0, "m", "start", &samples);
    }
    if topics.is_empty() {
        text(LEFT, HEAD + 20.0, "m", "start", "no topic says its times");
    }
    if left_out > 0 {
        let more = format!("{left_out} topics with shorter delays are not shown");
        text(LEFT, height - 12.0, "m", "start", &more);
    }
    for (at, (_, topic)) in topics.iter().enumerate() {
        let y = HEAD + ROW * count(at);
        let scale = BAR / longest;
        let (origin, network) = (
            median(&topic.origin) * scale,
            median(&topic.network) * scale,
        );
        bar(&mut svg, "o", (LEFT, y + 8.0), (origin, 16.0));
        bar(&mut svg, "n", (LEFT + origin, y + 8.0), (network, 16.0));
        histogram(&mut svg, &topic.network, y);
    }
    svg.push_str("</svg>\n");
    svg
}

fn abbreviated(name: &str) -> String {
    if name.chars().count() > MOST_NAME {
        name.chars().take(MOST_NAME - 1).chain(['…']).collect()
    } else {
        name.to_owned()
    }
}

fn bar(svg: &mut String, class: &str, (x, y): (f64, f64), (width, height): (f64, f64)) {
    if width > 0.0 && height > 0.0 {
        let width = width.max(1.0);
        // Writing to a String cannot fail.
        let _written = writeln!(
            svg,
            "<rect class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{height:.1}\"/>"
        );
    }
}

/// Draws the distribution of the delays of a hop, by decades.
fn histogram(svg: &mut String, window: &DelayWindow, y: f64) {
    let mut bins = [0_u32; BINS];
    for micros in window.last() {
        let decades = micros.max(1.0).log10();
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "0 to the number of bins, and larger numbers saturate"
        )]
        let bin = (decades * BINS_OF_DECADE) as usize;
        if let Some(bin) = bins.get_mut(bin.min(BINS - 1)) {
            *bin += 1;
        }
    }
    let most = f64::from(bins.iter().copied().max().unwrap_or_default().max(1));
    let width = SPAN / count(BINS);
    for (at, bin) in bins.iter().enumerate() {
        let height = f64::from(*bin) / most * 28.0;
        let x = RIGHT + width * count(at);
        bar(svg, "n", (x, y + 30.0 - height), (width - 1.0, height));
    }
    // Writing to a String cannot fail.
    let _written = writeln!(
        svg,
        "<line class=\"l\" x1=\"{RIGHT}\" y1=\"{0:.1}\" x2=\"{1}\" y2=\"{0:.1}\"/>",
        y + 30.5,
        RIGHT + SPAN
    );
}

/// Returns the delays of a hop, if it has any.
fn delays_of(window: &DelayWindow) -> Option<HopPage> {
    HopPage::of(window).filter(|hop| hop.count > 0)
}

/// Returns the median delay in microseconds; 0 without delays.
fn median(window: &DelayWindow) -> f64 {
    delays_of(window).map_or(0.0, |hop| hop.p50_us)
}

fn shown(delay: Option<f64>) -> String {
    delay.map_or_else(|| "-".to_owned(), micros)
}

#[expect(clippy::cast_precision_loss, reason = "a small number of rows")]
const fn count(number: usize) -> f64 {
    number as f64
}

const WIDTH: f64 = 1000.0;
const HEAD: f64 = 36.0;
const ROW: f64 = 56.0;
const FOOT: f64 = 30.0;
/// The left sides of the bars and of the distributions.
const LEFT: f64 = 250.0;
const RIGHT: f64 = 640.0;
/// The widths of the longest bar and of a distribution.
const BAR: f64 = 350.0;
const SPAN: f64 = 330.0;
/// Six decades from 1 us to 1 s.
const BINS: usize = 60;
const BINS_OF_DECADE: f64 = 10.0;
const MOST_TOPICS: usize = 40;
const MOST_NAME: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_topic_has_its_bars_its_distribution_and_an_escaped_name() {
        let mut delays = Delays::default();
        for (id, network) in [(10, 1_000), (11, 4_000_000)] {
            let mut topic = Topic::default();
            topic.origin.record(2_000);
            topic.network.record(network);
            delays.topics.insert(TopicId::new(1, 2, id).unwrap(), topic);
        }
        let name =
            |topic: TopicId| (topic.identifier.get() == 11).then(|| "a<b\u{FFFE}".to_owned());
        let svg = svg(&delays, &name);
        assert!(svg.starts_with("<svg ") && svg.ends_with("</svg>\n"));
        let slow = svg.find(">a&lt;b<").unwrap();
        let fast = svg.find(">ua_1_2_10<").unwrap();
        assert!(slow < fast, "the longest delay is first");
        // Two bars and one column of the distribution for each topic.
        assert_eq!(svg.matches("<rect ").count(), 6);
        assert!(super::svg(&Delays::default(), &|_| None).contains("no topic says its times"));
    }

    #[test]
    fn the_number_of_topics_is_bounded() {
        let mut delays = Delays::default();
        for id in 1..=50 {
            let mut topic = Topic::default();
            topic.network.record(1_000);
            delays.topics.insert(TopicId::new(1, 2, id).unwrap(), topic);
        }
        let svg = svg(&delays, &|_| None);
        assert!(svg.contains("10 topics with shorter delays are not shown"));
    }
}
