// The commands both makers' peers have; README.md beside this file lists them.
#include <atomic>
#include <chrono>
#include <set>
#include <thread>

#include "domain.hpp"
#include "lines.hpp"

using Clock = std::chrono::steady_clock;

namespace {

void wait(const std::function<bool()>& condition) {
    while (!condition()) {
        std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
}

// The bodies to send: numbered texts of --size, or those of --text and --hex in turn.
class Source {
public:
    explicit Source(const Arguments& arguments)
        : size_(static_cast<size_t>(arguments.number("size", 0)))
        , first_(static_cast<uint32_t>(arguments.number("first", 0))) {
        for (const auto& text : arguments.all("text")) {
            fixed_.push_back(of_text(text));
        }
        for (const auto& digits : arguments.all("hex")) {
            fixed_.push_back(of_hex(digits));
        }
        if (fixed_.empty() == (size_ == 0)) {
            Arguments::fail("pub needs --size, or --text and --hex");
        }
    }

    Body body(uint64_t turn) const {
        if (size_ > 0) {
            return of_text(Numbered::text(first_ + static_cast<uint32_t>(turn), size_));
        }
        return fixed_[turn % fixed_.size()];
    }

    size_t turns() const { return size_ > 0 ? 1 : fixed_.size(); }

private:
    size_t size_;
    uint32_t first_;
    std::vector<Body> fixed_;
};

void publish(const Arguments& arguments) {
    const Source source(arguments);
    const std::string topic = arguments.position(1, "a topic");
    const std::string type = dds_type("msg", arguments.position(2, "a type"));
    const auto participant = join(arguments);
    std::unique_ptr<Writer> first;
    if (const std::string before = arguments.text("after", ""); !before.empty()) {
        first = participant->writer(dds_topic("rt", before), type, {});
        wait([&] { return first->readers() > 0; });
    }
    const auto writer = participant->writer(dds_topic("rt", topic), type, Quality::from(arguments));
    Line().field("ready", topic);
    const int readers = static_cast<int>(arguments.number("wait-readers", 0));
    wait([&] { return writer->readers() >= readers; });
    if (readers > 0) {
        Line().field("matched", readers);
    }

    const auto count = static_cast<uint64_t>(arguments.number("count", static_cast<double>(source.turns())));
    const double rate = arguments.number("rate", 10);
    const auto start = Clock::now();
    uint64_t refused = 0;
    uint64_t sent = 0;
    for (; (count == 0 || sent < count) && !Lifetime::told(); ++sent) {
        const Body body = source.body(sent);
        std::this_thread::sleep_until(
            start + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(double(sent) / rate)));
        refused += writer->write(body) ? 0 : 1;
    }
    const double took = std::chrono::duration<double>(Clock::now() - start).count();
    Line().field("sent", sent).field("refused", refused).field("seconds", took);
    if (arguments.has("acknowledged")) {
        Line().field("acknowledged", writer->acknowledged(arguments.number("acknowledged", 10)));
    }
    Lifetime::wait_until_told();
}

// What a subscriber has heard, by number.
class Tally {
public:
    void add(std::optional<std::string_view> text) {
        ++received_;
        const auto number = text ? Numbered::number(*text) : std::nullopt;
        if (!number) {
            return;
        }
        bad_ += Numbered::is_whole(*text) ? 0 : 1;
        if (!numbers_.insert(*number).second) {
            ++repeated_;
        }
        disordered_ += last_ && *number < *last_ ? 1 : 0;
        last_ = number;
    }

    uint64_t received() const { return received_; }

    void say() const {
        Line line;
        line.field("received", received_).field("bad", bad_).field("repeated", repeated_);
        line.field("disordered", disordered_).field("distinct", numbers_.size());
        if (!numbers_.empty()) {
            const uint64_t span = uint64_t{*numbers_.rbegin()} - *numbers_.begin() + 1;
            line.field("first", *numbers_.begin()).field("last", *last_).field("missing", span - numbers_.size());
        }
    }

private:
    uint64_t received_ = 0;
    uint64_t bad_ = 0;
    uint64_t repeated_ = 0;
    uint64_t disordered_ = 0;
    std::optional<uint32_t> last_;
    std::set<uint32_t> numbers_;
};

void say(const std::string& topic, const Sample& sample, bool raw) {
    const auto text = text_of(sample.body);
    const auto number = text ? Numbered::number(*text) : std::nullopt;
    Line line;
    line.field("topic", topic).field("size", sample.body.size()).field("source", sample.source);
    if (number) {
        line.field("seq", *number).field("ok", Numbered::is_whole(*text));
    }
    if (text && text->size() <= 4096) {
        line.put("value", "{\"data\":" + Line::quoted(std::string(*text)) + "}");
    }
    if (raw) {
        line.field("hex", hex(sample.body));
    }
}

void subscribe(const Arguments& arguments) {
    const std::string topic = arguments.position(1, "a topic");
    const bool counts = arguments.has("counts");
    const bool raw = arguments.has("raw");
    std::mutex heard;
    Tally tally;
    const auto participant = join(arguments);
    const auto reader = participant->reader(dds_topic("rt", topic), dds_type("msg", arguments.position(2, "a type")),
        Quality::from(arguments), [&](const Sample& sample) {
            if (!counts) {
                say(topic, sample, raw);
            }
            const std::lock_guard<std::mutex> guard(heard);
            tally.add(text_of(sample.body));
        });
    Line().field("ready", topic);
    uint64_t said = 0;
    int writers = 0;
    while (!Lifetime::told()) {
        std::this_thread::sleep_for(std::chrono::milliseconds(50));
        if (const int now = reader->writers(); now != writers) {
            writers = now;
            Line().field("writers", writers);
        }
        const std::lock_guard<std::mutex> guard(heard);
        if (counts && tally.received() != said) {
            said = tally.received();
            tally.say();
        }
    }
    const std::lock_guard<std::mutex> guard(heard);
    tally.say();
}

void relay(const Arguments& arguments) {
    const std::string from = arguments.position(1, "a topic to read");
    const std::string to = arguments.position(2, "a topic to write");
    const std::string type = dds_type("msg", arguments.text("type", "std_msgs/String"));
    const auto participant = join(arguments);
    const Quality quality = Quality::from(arguments);
    const auto writer = participant->writer(dds_topic("rt", to), type, quality);
    std::atomic<uint64_t> refused = 0;
    const auto reader = participant->reader(dds_topic("rt", from), type, quality,
        [&](const Sample& sample) { refused += writer->write(sample.body) ? 0 : 1; });
    Line().field("ready", to);
    Lifetime::wait_until_told();
    Line().field("refused", refused.load());
}

// Many at once: member k writes the text k to TOPIC followed by k, and hears --hear, or --hear-each followed by k.
void crowd(const Arguments& arguments) {
    const std::string topic = arguments.position(1, "what the topics begin with");
    const int members = static_cast<int>(arguments.number("members", 13));
    const std::string type = dds_type("msg", "std_msgs/String");
    const Quality quality = Quality::from(arguments);
    const auto heard_by = [&](int member) {
        const std::string each = arguments.text("hear-each", "");
        return each.empty() ? arguments.text("hear", "") : each + std::to_string(member);
    };
    std::vector<std::unique_ptr<Participant>> participants;
    std::vector<std::unique_ptr<Writer>> writers;
    std::vector<std::unique_ptr<Reader>> readers;
    for (int member = 1; member <= members; ++member) {
        if (participants.empty() || !arguments.has("one-participant")) {
            participants.push_back(join(arguments));
        }
        auto& own = *participants.back();
        writers.push_back(own.writer(dds_topic("rt", topic + std::to_string(member)), type, quality));
        if (const std::string hear = heard_by(member); !hear.empty()) {
            readers.push_back(own.reader(dds_topic("rt", hear), type, quality, [member](const Sample& sample) {
                const auto text = text_of(sample.body).value_or("");
                Line().field("member", member).field("heard", std::string(text));
            }));
        }
    }
    Line().field("ready", members);
    while (!Lifetime::told()) {
        for (int member = 1; member <= members; ++member) {
            writers[member - 1]->write(of_text(std::to_string(member)));
        }
        std::this_thread::sleep_for(std::chrono::milliseconds(200));
    }
}

} // namespace

bool run_shared(const std::string& command, const Arguments& arguments) {
    if (command == "pub") {
        publish(arguments);
    } else if (command == "sub") {
        subscribe(arguments);
    } else if (command == "relay") {
        relay(arguments);
    } else if (command == "crowd") {
        crowd(arguments);
    } else {
        return run_measuring(command, arguments);
    }
    return true;
}
