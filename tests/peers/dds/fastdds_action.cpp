#include "fastdds_action.hpp"

#include <array>
#include <deque>
#include <map>
#include <numeric>
#include <set>

#include "fastdds.hpp"

namespace {

using Id = std::array<uint8_t, 16>;
enum Status : int8_t { UNKNOWN, ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED };

// CDR in little endian, whose alignment counts from its first byte.
class Out {
public:
    Out& byte(uint8_t value) {
        body_.push_back(value);
        return *this;
    }
    Out& id(const Id& id) {
        body_.insert(body_.end(), id.begin(), id.end());
        return *this;
    }
    Out& word(int32_t value) {
        body_.resize((body_.size() + 3) / 4 * 4);
        for (int shift = 0; shift < 32; shift += 8) {
            body_.push_back(static_cast<uint8_t>(static_cast<uint32_t>(value) >> shift));
        }
        return *this;
    }
    // A goal's stamp, which counts goals.
    Out& stamp(int32_t number) { return word(number).word(0); }
    Out& words(const std::vector<int32_t>& values) {
        word(static_cast<int32_t>(values.size()));
        for (const int32_t value : values) {
            word(value);
        }
        return *this;
    }
    const Body& body() const { return body_; }

private:
    Body body_;
};

Id id_of(const Body& body) {
    Id id{};
    if (body.size() >= id.size()) {
        std::copy_n(body.begin(), id.size(), id.begin());
    }
    return id;
}

int32_t word_of(const Body& body, size_t at) {
    uint32_t value = 0;
    for (size_t byte = 0; byte < 4 && at + byte < body.size(); ++byte) {
        value |= static_cast<uint32_t>(body[at + byte]) << (8 * byte);
    }
    return static_cast<int32_t>(value);
}

std::vector<int32_t> words_of(const Body& body, size_t at) {
    std::vector<int32_t> words;
    for (int32_t word = 0; word < word_of(body, at) && word < 1000; ++word) {
        words.push_back(word_of(body, at + 4 + 4 * static_cast<size_t>(word)));
    }
    return words;
}

std::string said(const std::vector<int32_t>& words) {
    std::string json = "[";
    for (const int32_t word : words) {
        json += (json.size() > 1 ? "," : "") + std::to_string(word);
    }
    return json + "]";
}

struct Names {
    std::string base;
    Service send, cancel, result;

    explicit Names(const std::string& action)
        : base(action + "/_action")
        , send(base + "/send_goal", "action", "demo_msgs/Fibonacci_SendGoal")
        , cancel(base + "/cancel_goal", "srv", "action_msgs/CancelGoal")
        , result(base + "/get_result", "action", "demo_msgs/Fibonacci_GetResult") { }

    std::string feedback() const { return dds_topic("rt", base + "/feedback"); }
    std::string feedback_type() const { return dds_type("action", "demo_msgs/Fibonacci_FeedbackMessage"); }
    std::string status() const { return dds_topic("rt", base + "/status"); }
    std::string status_type() const { return dds_type("msg", "action_msgs/GoalStatusArray"); }
};

Quality latched() {
    Quality quality;
    quality.transient_local = true;
    quality.depth = 1;
    return quality;
}

// One end of a service: what it hears waits to be taken.
class End {
public:
    struct Heard {
        Body body;
        rtps::SampleIdentity request;
    };

    End(FastParticipant& participant, const Service& service, bool server)
        : writer_(server ? participant.writer(service.reply, service.reply_type, Quality())
                         : participant.writer(service.request, service.request_type, Quality()))
        , reader_(participant.informed(server ? service.request : service.reply,
              server ? service.request_type : service.reply_type, Quality(),
              [this, server](const Body& body, const fast::SampleInfo& info) {
                  const std::lock_guard<std::mutex> guard(lock_);
                  heard_.push_back({body, server ? client_of(info) : info.related_sample_identity});
              })) { }

    std::deque<Heard> take() {
        const std::lock_guard<std::mutex> guard(lock_);
        return std::exchange(heard_, {});
    }

    void reply(const rtps::SampleIdentity& to, const Body& body) {
        fast_writer().reply(to, body);
    }

    bool matched() { return writer_->readers() > 0 && reader_->writers() > 0; }

    // Asks and waits for the reply; what `meanwhile` does is done in between.
    template <typename Meanwhile> Body ask(const Body& body, Meanwhile meanwhile) {
        rtps::WriteParams params;
        params.related_sample_identity().writer_guid() = reader_->guid();
        fast_writer().write(body, params);
        const auto number = params.sample_identity().sequence_number();
        while (true) {
            for (const auto& heard : take()) {
                const auto& of = heard.request.writer_guid();
                const bool own = of == reader_->guid() || of == fast_writer().guid();
                if (own && heard.request.sequence_number() == number) {
                    return heard.body;
                }
            }
            meanwhile();
            std::this_thread::sleep_for(std::chrono::milliseconds(2));
        }
    }

private:
    FastWriter& fast_writer() { return static_cast<FastWriter&>(*writer_); }

    std::mutex lock_;
    std::deque<Heard> heard_;
    std::unique_ptr<Writer> writer_;
    std::unique_ptr<FastReader> reader_;
};

struct Goal {
    int32_t order = 0;
    int32_t stamp = 0;
    Status status = ACCEPTED;
    std::vector<int32_t> numbers;
    std::vector<rtps::SampleIdentity> waiting;

    Body result() const { return Out().byte(static_cast<uint8_t>(status)).words(numbers).body(); }
};

class Server {
public:
    Server(FastParticipant& participant, const Names& names)
        : send_(participant, names.send, true)
        , cancel_(participant, names.cancel, true)
        , result_(participant, names.result, true)
        , feedback_(participant.writer(names.feedback(), names.feedback_type(), Quality()))
        , status_(participant.writer(names.status(), names.status_type(), latched())) { }

    void turn() {
        for (const auto& heard : send_.take()) {
            take_goal(heard);
        }
        for (const auto& heard : cancel_.take()) {
            take_cancel(heard);
        }
        for (const auto& heard : result_.take()) {
            const auto found = goals_.find(id_of(heard.body));
            if (found == goals_.end()) {
                result_.reply(heard.request, Goal{0, 0, UNKNOWN, {}, {}}.result());
            } else if (found->second.status >= SUCCEEDED) {
                result_.reply(heard.request, found->second.result());
            } else {
                found->second.waiting.push_back(heard.request);
            }
        }
        for (auto& [id, goal] : goals_) {
            work(id, goal);
        }
    }

private:
    void take_goal(const End::Heard& heard) {
        const Id id = id_of(heard.body);
        const int32_t order = word_of(heard.body, 16);
        const bool accepted = order != -1 && goals_.count(id) == 0;
        Line().field("goal", order).field("accepted", accepted);
        const auto stamp = static_cast<int32_t>(goals_.size() + 1);
        send_.reply(heard.request, Out().byte(accepted).stamp(stamp).body());
        if (accepted) {
            goals_[id] = Goal{order, stamp, ACCEPTED, {}, {}};
            publish();
        }
    }

    void take_cancel(const End::Heard& heard) {
        const Id wanted = id_of(heard.body);
        const int32_t until = word_of(heard.body, 16);
        const bool all = wanted == Id{} && until == 0;
        std::vector<Id> found;
        for (auto& [id, goal] : goals_) {
            const bool meant = all || id == wanted || (until > 0 && goal.stamp <= until);
            if (meant && goal.status <= EXECUTING) {
                goal.status = CANCELING;
                found.push_back(id);
            }
        }
        const bool one = wanted != Id{} && until == 0 && found.empty();
        Out answer;
        answer.byte(!one ? 0 : goals_.count(wanted) == 0 ? 2 : 3).word(static_cast<int32_t>(found.size()));
        for (const Id& id : found) {
            answer.id(id).stamp(goals_[id].stamp);
        }
        cancel_.reply(heard.request, answer.body());
        publish();
    }

    void work(const Id& id, Goal& goal) {
        if (goal.status == ACCEPTED) {
            goal.status = EXECUTING;
            publish();
        } else if (goal.status == CANCELING) {
            end(goal, CANCELED);
        } else if (goal.status == EXECUTING && goal.order == -2) {
            end(goal, ABORTED);
        } else if (goal.status == EXECUTING) {
            auto& numbers = goal.numbers;
            const auto most = static_cast<size_t>(goal.order >= 100 ? 3 : goal.order);
            if (numbers.size() < most) {
                numbers.push_back(numbers.size() < 2 ? 1 : numbers.back() + numbers[numbers.size() - 2]);
                feedback_->write(Out().id(id).words(numbers).body());
            } else if (goal.order < 100) {
                end(goal, SUCCEEDED);
            }
        }
    }

    void end(Goal& goal, Status status) {
        goal.status = status;
        publish();
        for (const auto& who : std::exchange(goal.waiting, {})) {
            result_.reply(who, goal.result());
        }
    }

    void publish() {
        Out list;
        list.word(static_cast<int32_t>(goals_.size()));
        for (const auto& [id, goal] : goals_) {
            list.id(id).stamp(goal.stamp).byte(static_cast<uint8_t>(goal.status));
        }
        status_->write(list.body());
    }

    std::map<Id, Goal> goals_;
    End send_, cancel_, result_;
    std::unique_ptr<Writer> feedback_, status_;
};

} // namespace

void action_serve(const Arguments& arguments) {
    const Names names(arguments.position(1, "an action"));
    FastParticipant participant(arguments);
    Server server(participant, names);
    Line().field("ready", arguments.position(1, "an action"));
    while (!Lifetime::told()) {
        server.turn();
        std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
}

void action_call(const Arguments& arguments) {
    const Names names(arguments.position(1, "an action"));
    FastParticipant participant(arguments);
    End send(participant, names.send, false);
    End cancel(participant, names.cancel, false);
    End result(participant, names.result, false);
    std::mutex lock;
    std::map<Id, std::vector<int32_t>> numbers;
    std::set<std::pair<Id, int>> statuses;
    const auto feedback = participant.reader(
        names.feedback(), names.feedback_type(), Quality(), [&](const Sample& sample) {
            const std::lock_guard<std::mutex> guard(lock);
            numbers[id_of(sample.body)] = words_of(sample.body, 16);
        });
    const auto status
        = participant.reader(names.status(), names.status_type(), latched(), [&](const Sample& sample) {
              const std::lock_guard<std::mutex> guard(lock);
              size_t at = 4;
              for (int32_t goal = 0; goal < word_of(sample.body, 0); ++goal) {
                  const Body rest(sample.body.begin() + static_cast<long>(std::min(at, sample.body.size())),
                      sample.body.end());
                  at = (at + 16 + 3) / 4 * 4 + 8;
                  if (at < sample.body.size()) {
                      statuses.emplace(id_of(rest), sample.body[at++]);
                  }
              }
          });
    Line().field("ready", arguments.position(1, "an action"));
    while (!(send.matched() && cancel.matched() && result.matched() && feedback->writers() && status->writers())) {
        std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
    uint8_t turn = 0;
    for (const auto& text : arguments.all("order")) {
        const int32_t order = std::stoi(text);
        Id id;
        id.fill(++turn);
        const Body answer = send.ask(Out().id(id).word(order).body(), [] { });
        Line().field("order", order).field("accepted", answer.at(0) != 0);
        if (answer.at(0) == 0) {
            continue;
        }
        bool asked = order < 100;
        const Body end = result.ask(Out().id(id).body(), [&] {
            std::unique_lock<std::mutex> guard(lock);
            if (!asked && numbers[id].size() == 3) {
                guard.unlock();
                asked = true;
                const Body code = cancel.ask(Out().id(id).stamp(0).body(), [] { });
                Line().field("cancel", static_cast<int>(code.at(0))).field("goals", word_of(code, 4));
            }
        });
        // They are other topics: the last feedback and the status of the end may come behind the result.
        const auto patience = std::chrono::steady_clock::now() + std::chrono::seconds(2);
        std::unique_lock<std::mutex> guard(lock);
        const auto told = [&] { return statuses.count({id, end.at(0)}) > 0; };
        while (!(told() && numbers[id].size() >= words_of(end, 4).size()) && std::chrono::steady_clock::now() < patience) {
            guard.unlock();
            std::this_thread::sleep_for(std::chrono::milliseconds(2));
            guard.lock();
        }
        Line()
            .field("order", order)
            .field("status", static_cast<int>(end.at(0)))
            .put("result", said(words_of(end, 4)))
            .put("feedback", said(numbers[id]))
            .field("told", told());
    }
    Line().field("done", true);
    Lifetime::wait_until_told();
}
