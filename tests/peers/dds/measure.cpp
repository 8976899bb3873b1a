// The commands that measure; README.md beside this file lists them. What to do comes in lines on standard input, so that
// several of these peers can take turns.
#include <algorithm>
#include <chrono>
#include <condition_variable>
#include <sstream>
#include <thread>

#include "domain.hpp"
#include "lines.hpp"

using Clock = std::chrono::steady_clock;

namespace {

int64_t now() {
    return std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now().time_since_epoch()).count();
}

// Filler, then 8 digits of a topic, 12 of a number, 16 of a time: nanoseconds of the machine's monotonic clock.
struct Stamp {
    static constexpr size_t LENGTH = 36;

    uint32_t topic;
    uint64_t number;
    int64_t sent;

    void put(Body& body, size_t size) const {
        const size_t length = std::max(size, LENGTH);
        if (body.size() != 4 + length + 1) {
            body = of_text(std::string(length, '.'));
        }
        char digits[LENGTH + 1];
        std::snprintf(digits, sizeof digits, "%08u%012llu%016lld", topic % 100000000,
            static_cast<unsigned long long>(number % 1000000000000), static_cast<long long>(sent));
        std::memcpy(body.data() + 4 + length - LENGTH, digits, LENGTH);
    }

    static std::optional<Stamp> of(const Body& body) {
        const auto text = text_of(body);
        if (!text || text->size() < LENGTH) {
            return std::nullopt;
        }
        const std::string digits(text->substr(text->size() - LENGTH));
        if (digits.find_first_not_of("0123456789") != std::string::npos) {
            return std::nullopt;
        }
        return Stamp{static_cast<uint32_t>(std::stoul(digits.substr(0, 8))), std::stoull(digits.substr(8, 12)),
            std::stoll(digits.substr(20))};
    }
};

// The bytes of a message around a text, which is its data then: --head, whose length is a multiple of 4, and --tail.
struct Frame {
    std::string type;
    Body head;
    Body tail;

    static Frame from(const Arguments& arguments) {
        const Frame frame{dds_type("msg", arguments.text("type", "std_msgs/String")), of_hex(arguments.text("head", "")),
            of_hex(arguments.text("tail", ""))};
        if (frame.head.size() % 4 != 0) {
            Arguments::fail("--head is a multiple of 4 bytes");
        }
        return frame;
    }

    bool is_plain() const { return head.empty() && tail.empty(); }

    // The message around a text.
    Body around(const Body& text) const {
        Body whole;
        whole.reserve(head.size() + text.size() + tail.size());
        whole.insert(whole.end(), head.begin(), head.end());
        whole.insert(whole.end(), text.begin(), text.end());
        whole.insert(whole.end(), tail.begin(), tail.end());
        return whole;
    }

    // The stamp of a message; its head may differ, as a header does that was made anew.
    std::optional<Stamp> stamp(const Body& whole) const {
        if (is_plain()) {
            return Stamp::of(whole);
        }
        if (whole.size() < head.size() + 5 + tail.size()) {
            return std::nullopt;
        }
        const auto begin = whole.begin() + static_cast<ptrdiff_t>(head.size());
        uint32_t length = 0;
        std::memcpy(&length, &*begin, sizeof length);
        const size_t end = head.size() + 4 + length;
        if (length < Stamp::LENGTH + 1 || end + tail.size() > whole.size()) {
            return std::nullopt;
        }
        Body text = of_text(std::string(reinterpret_cast<const char*>(whole.data()) + end - Stamp::LENGTH - 1, Stamp::LENGTH));
        return Stamp::of(text);
    }
};

// Filler, then a number of 11 digits: with its length and the NUL a text of one is 16 bytes.
struct Ticket {
    static constexpr size_t LENGTH = 11;

    static void put(Body& body, size_t size, uint64_t number) {
        const size_t length = std::max(size, LENGTH);
        if (body.size() != 4 + length + 1) {
            body = of_text(std::string(length, '.'));
        }
        char digits[LENGTH + 1];
        std::snprintf(digits, sizeof digits, "%011llu", static_cast<unsigned long long>(number % 100000000000));
        std::memcpy(body.data() + 4 + length - LENGTH, digits, LENGTH);
    }

    static std::optional<uint64_t> of(const Body& body) {
        const auto text = text_of(body);
        if (!text || text->size() < LENGTH) {
            return std::nullopt;
        }
        const std::string digits(text->substr(text->size() - LENGTH));
        if (digits.find_first_not_of("0123456789") != std::string::npos) {
            return std::nullopt;
        }
        return std::stoull(digits);
    }
};

std::string json(const std::vector<int64_t>& numbers) {
    std::string text = "[";
    for (const int64_t number : numbers) {
        text += (text.size() > 1 ? "," : "") + std::to_string(number);
    }
    return text + "]";
}

// One way there and back. What comes back sends the next one, from the middleware's own thread, as a relay does.
class Lane {
public:
    Lane(Participant& participant, const std::string& there, const std::string& back, const Quality& quality,
        std::chrono::milliseconds patience)
        : patience_(patience) {
        const std::string type = dds_type("msg", "std_msgs/String");
        writer_ = participant.writer(dds_topic("rt", there), type, quality);
        reader_ = participant.reader(
            dds_topic("rt", back), type, quality, [this](const Sample& sample) { hear(sample.body); });
    }

    void pass(int lane, uint64_t count, size_t size, uint64_t window) {
        std::unique_lock<std::mutex> guard(lock_);
        times_.clear();
        sent_.clear();
        first_ = next_;
        end_ = next_ + count;
        size_ = size;
        uint64_t lost = 0;
        const auto start = Clock::now();
        for (uint64_t sent = 0; sent < window; ++sent) {
            send();
        }
        uint64_t before = 0;
        while (times_.size() + lost < count) {
            const bool all = changed_.wait_for(guard, patience_, [&] { return times_.size() + lost >= count; });
            if (!all && times_.size() == before) {
                // Nothing for so long: what is under way is lost, and others take its place.
                const uint64_t missing = next_ - first_ - times_.size() - lost;
                lost += missing;
                first_after_loss_ = next_;
                for (uint64_t sent = 0; sent < window; ++sent) {
                    send();
                }
            }
            before = times_.size();
        }
        const double seconds = std::chrono::duration<double>(Clock::now() - start).count();
        Line().field("lane", lane).field("lost", lost).field("seconds", seconds).put("ns", json(times_));
    }

private:
    void send() {
        if (next_ < end_) {
            Ticket::put(body_, size_, next_++);
            sent_.push_back(now());
            writer_->write(body_);
        }
    }

    void hear(const Body& body) {
        const int64_t heard = now();
        const auto number = Ticket::of(body);
        const std::lock_guard<std::mutex> guard(lock_);
        if (!number || *number < std::max(first_, first_after_loss_) || *number >= next_) {
            return;
        }
        times_.push_back(heard - sent_[*number - first_]);
        send();
        if (next_ == end_) {
            changed_.notify_all();
        }
    }

    std::chrono::milliseconds patience_;
    std::mutex lock_;
    std::condition_variable changed_;
    uint64_t next_ = 0;
    uint64_t first_ = 0;
    uint64_t first_after_loss_ = 0;
    uint64_t end_ = 0;
    size_t size_ = 0;
    Body body_;
    std::vector<int64_t> times_;
    // When what was sent since `first_` was.
    std::vector<int64_t> sent_;
    std::unique_ptr<Writer> writer_;
    std::unique_ptr<Reader> reader_;
};

void ping(const Arguments& arguments) {
    const auto participant = join(arguments);
    const Quality quality = Quality::from(arguments);
    const int pairs = static_cast<int>(arguments.number("pairs", 1));
    const std::chrono::milliseconds patience(static_cast<int64_t>(arguments.number("patience", 2) * 1000));
    std::vector<std::unique_ptr<Lane>> lanes;
    for (int pair = 0; pair < pairs; ++pair) {
        const auto there = arguments.position(1 + 2 * static_cast<size_t>(pair), "a topic to write");
        const auto back = arguments.position(2 + 2 * static_cast<size_t>(pair), "a topic to read");
        lanes.push_back(std::make_unique<Lane>(*participant, there, back, quality, patience));
    }
    Line().field("ready", pairs);
    while (const auto line = Lifetime::line()) {
        std::istringstream words(*line);
        size_t lane = 0, size = 0;
        uint64_t count = 0, window = 1;
        if (!(words >> lane >> count >> size >> window) || lane >= lanes.size()) {
            return;
        }
        lanes[lane]->pass(static_cast<int>(lane), count, size, window);
    }
}

// The topics of --topics: the one of that name, or so many whose names begin with it and end with 0 and up.
std::vector<std::string> topics_of(const Arguments& arguments) {
    const std::string name = arguments.position(1, "a topic");
    const int topics = static_cast<int>(arguments.number("topics", 0));
    const int first = static_cast<int>(arguments.number("first", 0));
    std::vector<std::string> names;
    for (int topic = 0; topic < topics; ++topic) {
        names.push_back(name + std::to_string(first + topic));
    }
    return topics > 0 ? names : std::vector<std::string>{name};
}

// Sends at absolute times. A sample's time begins when it is sent, so that the sender's own lateness does not count.
void pace(const Arguments& arguments) {
    const auto participant = join(arguments);
    const Quality quality = Quality::from(arguments);
    const Frame frame = Frame::from(arguments);
    std::vector<std::unique_ptr<Writer>> writers;
    for (const auto& topic : topics_of(arguments)) {
        writers.push_back(participant->writer(dds_topic("rt", topic), frame.type, quality));
    }
    const bool spread = arguments.has("spread");
    Line().field("ready", writers.size());
    Body body;
    uint64_t number = 0;
    while (const auto line = Lifetime::line()) {
        std::istringstream words(*line);
        uint64_t ticks = 0, burst = 0;
        size_t size = 0;
        int64_t period = 0, pause = 0;
        if (!(words >> ticks >> size >> period >> burst >> pause)) {
            return;
        }
        uint64_t refused = 0;
        // Those of a millisecond.
        const uint64_t at_once = std::max<uint64_t>(1, writers.size() * 1000000 / std::max<int64_t>(period, 1));
        const uint64_t first = number;
        auto due = Clock::now();
        const auto start = due;
        for (uint64_t tick = 0; tick < ticks; ++tick, ++number) {
            if (burst > 0 && tick > 0 && tick % burst == 0) {
                due = Clock::now() + std::chrono::nanoseconds(pause);
            }
            std::this_thread::sleep_until(due);
            for (uint32_t topic = 0; topic < writers.size(); ++topic) {
                const auto later = std::chrono::nanoseconds(period) * topic / writers.size();
                if (spread && topic % at_once == 0) {
                    std::this_thread::sleep_until(due + later);
                }
                Stamp{topic, number, now()}.put(body, size);
                refused += writers[topic]->write(frame.is_plain() ? body : frame.around(body)) ? 0 : 1;
            }
            due += std::chrono::nanoseconds(period);
        }
        const double seconds = std::chrono::duration<double>(Clock::now() - start).count();
        int readers = 0;
        for (const auto& writer : writers) {
            readers += writer->readers();
        }
        Line()
            .field("first", first)
            .field("sent", ticks * writers.size())
            .field("refused", refused)
            .field("seconds", seconds)
            .field("readers", readers);
    }
}

// What one topic has brought since the last report.
class Heard {
public:
    void add(const Stamp& stamp, int64_t time) {
        const uint64_t at = stamp.number;
        if (numbers_.size() <= at) {
            numbers_.resize(at + 1);
        }
        if (numbers_[at]) {
            ++repeated;
            return;
        }
        numbers_[at] = true;
        ++distinct;
        disordered += at < next_ ? 1 : 0;
        next_ = at + 1;
        times.push_back(time);
    }
    void begin_anew() {
        times.clear();
        distinct = repeated = disordered = 0;
    }

    std::vector<int64_t> times;
    uint64_t distinct = 0;
    uint64_t repeated = 0;
    uint64_t disordered = 0;

private:
    std::vector<bool> numbers_;
    uint64_t next_ = 0;
};

void meter(const Arguments& arguments) {
    const auto participant = join(arguments);
    const Quality quality = Quality::from(arguments);
    const auto topics = topics_of(arguments);
    const Frame frame = Frame::from(arguments);
    std::mutex lock;
    std::vector<Heard> heard(topics.size());
    std::atomic<uint64_t> count = 0;
    std::atomic<int64_t> last = now();
    std::vector<std::unique_ptr<Reader>> readers;
    for (size_t topic = 0; topic < topics.size(); ++topic) {
        readers.push_back(participant->reader(dds_topic("rt", topics[topic]), frame.type,
            quality, [&, topic](const Sample& sample) {
                const int64_t arrived = now();
                if (const auto stamp = frame.stamp(sample.body)) {
                    const std::lock_guard<std::mutex> guard(lock);
                    heard[topic].add(*stamp, arrived - stamp->sent);
                    ++count;
                }
                last = arrived;
            }));
    }
    Line().field("ready", topics.size());
    // Each line: how many samples to wait for, and after how many ms of silence to wait no longer.
    while (const auto line = Lifetime::line()) {
        std::istringstream words(*line);
        uint64_t expected = 0;
        int64_t silence = 0;
        if (!(words >> expected >> silence)) {
            return;
        }
        last = now();
        while (count < expected && now() - last < silence * 1000000) {
            std::this_thread::sleep_for(std::chrono::milliseconds(1));
        }
        const std::lock_guard<std::mutex> guard(lock);
        uint64_t distinct = 0, repeated = 0, disordered = 0, fewest = UINT64_MAX;
        std::vector<int64_t> times;
        for (auto& topic : heard) {
            distinct += topic.distinct;
            fewest = std::min(fewest, topic.distinct);
            repeated += topic.repeated;
            disordered += topic.disordered;
            times.insert(times.end(), topic.times.begin(), topic.times.end());
            topic.begin_anew();
        }
        count = 0;
        Line().field("distinct", distinct).field("repeated", repeated).field("disordered", disordered).field(
            "fewest", fewest).put("ns", json(times));
    }
}

} // namespace

bool run_measuring(const std::string& command, const Arguments& arguments) {
    if (command == "ping") {
        ping(arguments);
    } else if (command == "pace") {
        pace(arguments);
    } else if (command == "meter") {
        meter(arguments);
    } else {
        return false;
    }
    return true;
}
