// Cyclone DDS by its C library. Its message is std_msgs/String, its service std_srvs/SetBool; CYCLONEDDS_URI names the
// interface, as everywhere.
#include <algorithm>
#include <atomic>
#include <cstdio>
#include <map>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include <dds/dds.h>

#include "domain.hpp"
#include "lines.hpp"
#include "ros_types.h"

namespace {

dds_entity_t made(dds_entity_t entity, const char* what) {
    if (entity < 0) {
        std::fprintf(stderr, "peer: Cyclone DDS makes no %s: %s\n", what, dds_strretcode(-entity));
        std::_Exit(1);
    }
    return entity;
}

// The policies rmw_cyclonedds sets.
dds_qos_t* policies(const Quality& quality) {
    dds_qos_t* qos = dds_create_qos();
    dds_qset_reliability(
        qos, quality.reliable ? DDS_RELIABILITY_RELIABLE : DDS_RELIABILITY_BEST_EFFORT, DDS_SECS(10));
    dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, quality.depth);
    dds_qset_durability(qos, quality.transient_local ? DDS_DURABILITY_TRANSIENT_LOCAL : DDS_DURABILITY_VOLATILE);
    if (quality.transient_local) {
        dds_qset_durability_service(qos, 0, DDS_HISTORY_KEEP_LAST, quality.depth, DDS_LENGTH_UNLIMITED,
            DDS_LENGTH_UNLIMITED, DDS_LENGTH_UNLIMITED);
    }
    return qos;
}

class CycloneWriter : public Writer {
public:
    CycloneWriter(dds_entity_t participant, dds_entity_t topic, const Quality& quality) {
        dds_qos_t* qos = policies(quality);
        dds_listener_t* listener = dds_create_listener(nullptr);
        dds_lset_offered_incompatible_qos(
            listener, [](dds_entity_t, const dds_offered_incompatible_qos_status_t status, void*) {
                Line().field("incompatible", status.last_policy_id);
            });
        writer_ = made(dds_create_writer(participant, topic, qos, listener), "writer");
        dds_delete_listener(listener);
        dds_delete_qos(qos);
    }

    bool write(const Body& body) override {
        if (!text_of(body)) {
            Arguments::fail("this peer writes std_msgs/String only");
        }
        // Cyclone copies the text, which ends with its zero.
        const std_msgs_msg_dds__String_ sample{const_cast<char*>(reinterpret_cast<const char*>(body.data())) + 4};
        return dds_write(writer_, &sample) == DDS_RETCODE_OK;
    }
    int readers() override {
        dds_publication_matched_status_t status;
        return dds_get_publication_matched_status(writer_, &status) == DDS_RETCODE_OK
            ? static_cast<int>(status.current_count)
            : 0;
    }
    bool acknowledged(double seconds) override {
        return dds_wait_for_acks(writer_, static_cast<dds_duration_t>(seconds * 1e9)) == DDS_RETCODE_OK;
    }

private:
    dds_entity_t writer_;
};

class CycloneReader : public Reader {
public:
    CycloneReader(dds_entity_t participant, dds_entity_t topic, const Quality& quality,
        std::function<void(const Sample&)> heard)
        : heard_(std::move(heard)) {
        dds_qos_t* qos = policies(quality);
        dds_listener_t* listener = dds_create_listener(this);
        dds_lset_data_available(
            listener, [](dds_entity_t reader, void* own) { static_cast<CycloneReader*>(own)->take(reader); });
        dds_lset_requested_incompatible_qos(
            listener, [](dds_entity_t, const dds_requested_incompatible_qos_status_t status, void*) {
                Line().field("incompatible", status.last_policy_id);
            });
        reader_ = made(dds_create_reader(participant, topic, qos, listener), "reader");
        dds_delete_listener(listener);
        dds_delete_qos(qos);
    }
    ~CycloneReader() override { dds_delete(reader_); }

    int writers() override {
        dds_subscription_matched_status_t status;
        return dds_get_subscription_matched_status(reader_, &status) == DDS_RETCODE_OK
            ? static_cast<int>(status.current_count)
            : 0;
    }

private:
    void take(dds_entity_t reader) {
        constexpr int MANY = 64;
        void* samples[MANY] = {};
        dds_sample_info_t infos[MANY];
        for (;;) {
            const dds_return_t taken = dds_take(reader, samples, infos, MANY, MANY);
            if (taken <= 0) {
                return;
            }
            for (int at = 0; at < taken; ++at) {
                if (infos[at].valid_data) {
                    hear(static_cast<std_msgs_msg_dds__String_*>(samples[at])->data, infos[at].source_timestamp);
                }
            }
            dds_return_loan(reader, samples, taken);
        }
    }

    void hear(const char* text, int64_t source) {
        const auto length = static_cast<uint32_t>(std::strlen(text) + 1);
        body_.resize(4 + length);
        for (int at = 0; at < 4; ++at) {
            body_[at] = static_cast<uint8_t>(length >> (8 * at));
        }
        std::memcpy(body_.data() + 4, text, length);
        heard_(Sample{body_, source});
    }

    std::function<void(const Sample&)> heard_;
    Body body_;
    dds_entity_t reader_;
};

class CycloneParticipant : public Participant {
public:
    explicit CycloneParticipant(const Arguments& arguments) {
        dds_qos_t* qos = dds_create_qos();
        const std::string enclave = "enclave=/;";
        dds_qset_userdata(qos, enclave.data(), enclave.size());
        participant_ = made(
            dds_create_participant(static_cast<dds_domainid_t>(arguments.number("domain", 0)), qos, nullptr),
            "participant");
        dds_delete_qos(qos);
    }
    ~CycloneParticipant() override { dds_delete(participant_); }

    std::unique_ptr<Writer> writer(const std::string& topic, const std::string& type, const Quality& quality) override {
        return std::make_unique<CycloneWriter>(participant_, make_topic(topic, type), quality);
    }
    std::unique_ptr<Reader> reader(const std::string& topic, const std::string& type, const Quality& quality,
        std::function<void(const Sample&)> heard) override {
        return std::make_unique<CycloneReader>(participant_, make_topic(topic, type), quality, std::move(heard));
    }

    dds_entity_t topic_of(const std::string& name, const dds_topic_descriptor_t& type) {
        return made(dds_create_topic(participant_, &type, name.c_str(), nullptr, nullptr), "topic");
    }
    dds_entity_t entity() const { return participant_; }

private:
    dds_entity_t make_topic(const std::string& name, const std::string& type) {
        if (type != std_msgs_msg_dds__String__desc.m_typename) {
            Arguments::fail("this peer knows std_msgs/String only, not " + type);
        }
        return topic_of(name, std_msgs_msg_dds__String__desc);
    }

    dds_entity_t participant_;
};

using Request = std_srvs_srv_dds__SetBool_Request_;
using Reply = std_srvs_srv_dds__SetBool_Response_;

// Calls `heard` with each sample there is.
template <typename Kind, typename Heard> void take_all(dds_entity_t reader, const Heard& heard) {
    void* samples[1] = {};
    dds_sample_info_t info;
    while (dds_take(reader, samples, &info, 1, 1) > 0) {
        if (info.valid_data) {
            heard(*static_cast<const Kind*>(samples[0]));
        }
        dds_return_loan(reader, samples, 1);
    }
}

// What one end of a service, or of a topic that goes one way, writes and reads.
struct Ends {
    dds_entity_t writer = 0;
    dds_entity_t reader = 0;

    bool matched() const {
        dds_publication_matched_status_t there;
        dds_subscription_matched_status_t back;
        return dds_get_publication_matched_status(writer, &there) == DDS_RETCODE_OK && there.current_count > 0
            && dds_get_subscription_matched_status(reader, &back) == DDS_RETCODE_OK && back.current_count > 0;
    }
};

dds_entity_t writer_of(CycloneParticipant& participant, dds_entity_t topic, const Quality& quality = {}) {
    dds_qos_t* qos = policies(quality);
    const dds_entity_t writer = made(dds_create_writer(participant.entity(), topic, qos, nullptr), "writer");
    dds_delete_qos(qos);
    return writer;
}

dds_entity_t reader_of(CycloneParticipant& participant, dds_entity_t topic) {
    dds_qos_t* qos = policies(Quality{});
    const dds_entity_t reader = made(dds_create_reader(participant.entity(), topic, qos, nullptr), "reader");
    dds_delete_qos(qos);
    return reader;
}

Ends ends(CycloneParticipant& participant, const std::string& name, const dds_topic_descriptor_t& request,
    const dds_topic_descriptor_t& reply, bool serves) {
    const dds_entity_t requests = participant.topic_of(dds_topic("rq", name, "Request"), request);
    const dds_entity_t replies = participant.topic_of(dds_topic("rr", name, "Reply"), reply);
    return serves ? Ends{writer_of(participant, replies), reader_of(participant, requests)}
                  : Ends{writer_of(participant, requests), reader_of(participant, replies)};
}

// Polls until told, or `done`.
template <typename Done> void poll(const Done& done) {
    while (!Lifetime::told() && !done()) {
        std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
}

void must_write(dds_entity_t writer, const void* sample) {
    if (dds_write(writer, sample) != DDS_RETCODE_OK) {
        Arguments::fail("a sample was not taken");
    }
}

// Wakes when a sample comes to a reader.
class Waiting {
public:
    Waiting(CycloneParticipant& participant, dds_entity_t reader)
        : set_(made(dds_create_waitset(participant.entity()), "waitset")) {
        const dds_entity_t condition = made(dds_create_readcondition(reader, DDS_ANY_STATE), "condition");
        made(dds_waitset_attach(set_, condition, 0), "attachment");
    }

    // Until a sample is there, or for so long.
    void wait(std::chrono::milliseconds time) const { dds_waitset_wait(set_, nullptr, 0, DDS_MSECS(time.count())); }

private:
    dds_entity_t set_;
};

Ends set_bool(CycloneParticipant& participant, const std::string& name, bool serves) {
    return ends(participant, name, std_srvs_srv_dds__SetBool_Request__desc, std_srvs_srv_dds__SetBool_Response__desc,
        serves);
}

// A server of std_srvs/SetBool, which answers each request with what it says and --text.
void serve(const Arguments& arguments) {
    const std::string name = arguments.position(1, "a service");
    std::string text = arguments.text("text", "served");
    CycloneParticipant participant(arguments);
    const Ends own = set_bool(participant, name, true);
    const bool quiet = arguments.has("quiet");
    const Waiting waiting(participant, own.reader);
    Line().field("ready", name);
    while (!Lifetime::told()) {
        waiting.wait(std::chrono::milliseconds(50));
        take_all<Request>(own.reader, [&](const Request& request) {
            const Reply reply{request.client, request.count, request.data, text.data()};
            const bool taken = dds_write(own.writer, &reply) == DDS_RETCODE_OK;
            if (!quiet) {
                Line().field("request", request.data).field("replied", taken);
            }
        });
    }
}

// A client of std_srvs/SetBool that is measured: each line, COUNT WINDOW, asks so often, with so many not answered at a time.
void calls(const Arguments& arguments) {
    using Clock = std::chrono::steady_clock;
    const std::string name = arguments.position(1, "a service");
    const auto patience = std::chrono::milliseconds(static_cast<int64_t>(1000 * arguments.number("patience", 5)));
    CycloneParticipant participant(arguments);
    const Ends own = set_bool(participant, name, false);
    const Waiting waiting(participant, own.reader);
    dds_instance_handle_t client = 0;
    dds_get_instance_handle(own.writer, &client);
    Line().field("ready", name);
    while (!own.matched()) {
        std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
    Line().field("matched", name);
    int64_t seq = 0;
    while (const auto order = Lifetime::line()) {
        std::istringstream words(*order);
        int64_t count = 0;
        size_t window = 1;
        words >> count >> window;
        std::map<int64_t, Clock::time_point> open;
        std::string took;
        int64_t asked = 0;
        int64_t answered = 0;
        const auto start = Clock::now();
        auto last = start;
        while (answered < count && Clock::now() - last < patience) {
            while (asked < count && open.size() < window) {
                const Request request{client, ++seq, true};
                open[seq] = Clock::now();
                must_write(own.writer, &request);
                ++asked;
            }
            waiting.wait(std::chrono::milliseconds(50));
            take_all<Reply>(own.reader, [&](const Reply& reply) {
                const auto found = open.find(reply.count);
                if (reply.client != client || found == open.end()) {
                    return;
                }
                last = Clock::now();
                const auto ns = std::chrono::duration_cast<std::chrono::nanoseconds>(last - found->second).count();
                took += (took.empty() ? "" : ",") + std::to_string(ns);
                open.erase(found);
                ++answered;
            });
        }
        const auto whole = std::chrono::duration<double>(last - start).count();
        Line().field("lost", count - answered).field("seconds", whole).put("ns", "[" + took + "]");
    }
}

// A client of std_srvs/SetBool that asks true --count times, one after the other.
void call(const Arguments& arguments) {
    const std::string name = arguments.position(1, "a service");
    const auto count = static_cast<int64_t>(arguments.number("count", 1));
    CycloneParticipant participant(arguments);
    const Ends own = set_bool(participant, name, false);
    dds_instance_handle_t client = 0;
    dds_get_instance_handle(own.writer, &client);
    Line().field("ready", name);
    poll([&] { return own.matched(); });
    for (int64_t seq = 1; seq <= count; ++seq) {
        const Request request{client, seq, true};
        must_write(own.writer, &request);
        bool answered = false;
        poll([&] {
            take_all<Reply>(own.reader, [&](const Reply& reply) {
                if (reply.client == client && reply.count == seq) {
                    answered = true;
                    Line().field("reply", reply.success).field("text", std::string(reply.message));
                }
            });
            return answered;
        });
    }
    Line().field("done", true);
    Lifetime::wait_until_told();
}

using Goal = demo_msgs_action_dds__Fibonacci_SendGoal_Request_;
using Accepted = demo_msgs_action_dds__Fibonacci_SendGoal_Response_;
using Wanted = demo_msgs_action_dds__Fibonacci_GetResult_Request_;
using Result = demo_msgs_action_dds__Fibonacci_GetResult_Response_;
using Feedback = demo_msgs_action_dds__Fibonacci_FeedbackMessage_;

// The endpoints of one end of the action Fibonacci.
struct Action {
    Action(CycloneParticipant& participant, const std::string& name, bool serves)
        : send(ends(participant, name + "/_action/send_goal", demo_msgs_action_dds__Fibonacci_SendGoal_Request__desc,
            demo_msgs_action_dds__Fibonacci_SendGoal_Response__desc, serves))
        , cancel(ends(participant, name + "/_action/cancel_goal", action_msgs_srv_dds__CancelGoal_Request__desc,
              action_msgs_srv_dds__CancelGoal_Response__desc, serves))
        , result(ends(participant, name + "/_action/get_result", demo_msgs_action_dds__Fibonacci_GetResult_Request__desc,
              demo_msgs_action_dds__Fibonacci_GetResult_Response__desc, serves)) {
        const dds_entity_t told = participant.topic_of(
            dds_topic("rt", name, "/_action/feedback"), demo_msgs_action_dds__Fibonacci_FeedbackMessage__desc);
        feedback = serves ? writer_of(participant, told) : reader_of(participant, told);
        if (serves) {
            Quality kept;
            kept.transient_local = true;
            writer_of(participant,
                participant.topic_of(
                    dds_topic("rt", name, "/_action/status"), action_msgs_msg_dds__GoalStatusArray__desc),
                kept);
        }
    }

    Ends send, cancel, result;
    dds_entity_t feedback;
};

constexpr uint8_t SUCCEEDED = 4;

std::vector<int32_t> fibonacci(int32_t order) {
    std::vector<int32_t> numbers;
    for (int32_t at = 0; at < order; ++at) {
        numbers.push_back(at < 2 ? 1 : numbers[at - 1] + numbers[at - 2]);
    }
    return numbers;
}

dds_sequence_long borrowed(std::vector<int32_t>& numbers) {
    const auto length = static_cast<uint32_t>(numbers.size());
    return {length, length, numbers.data(), false};
}

// Rejects orders below 0, and else succeeds when the result is asked for, with the numbers as feedback before.
void action_serve(const Arguments& arguments) {
    const std::string name = arguments.position(1, "an action");
    CycloneParticipant participant(arguments);
    const Action own(participant, name, true);
    std::map<std::string, int32_t> orders;
    const auto key = [](const uint8_t (&id)[16]) { return std::string(id, id + 16); };
    Line().field("ready", name);
    poll([&] {
        take_all<Goal>(own.send.reader, [&](const Goal& goal) {
            const bool accepted = goal.order >= 0;
            orders[key(goal.goal_id)] = goal.order;
            const Accepted reply{goal.client, goal.count, accepted, 1, 0};
            must_write(own.send.writer, &reply);
            Line().field("goal", goal.order).field("accepted", accepted);
        });
        take_all<Wanted>(own.result.reader, [&](const Wanted& wanted) {
            auto numbers = fibonacci(orders[key(wanted.goal_id)]);
            Feedback told{};
            std::copy(std::begin(wanted.goal_id), std::end(wanted.goal_id), told.goal_id);
            told.numbers = borrowed(numbers);
            must_write(own.feedback, &told);
            const Result reply{wanted.client, wanted.count, SUCCEEDED, borrowed(numbers)};
            must_write(own.result.writer, &reply);
        });
        return false;
    });
}

// Sends a goal of --order, asks for its result when it is accepted, and tells what comes.
void action_call(const Arguments& arguments) {
    const std::string name = arguments.position(1, "an action");
    CycloneParticipant participant(arguments);
    const Action own(participant, name, false);
    dds_instance_handle_t client = 0;
    dds_get_instance_handle(own.send.writer, &client);
    Line().field("ready", name);
    poll([&] { return own.send.matched() && own.result.matched(); });
    const Goal goal{client, 1, {7}, static_cast<int32_t>(arguments.number("order", 5))};
    must_write(own.send.writer, &goal);
    poll([&] {
        take_all<Accepted>(own.send.reader, [&](const Accepted& answer) {
            Line().field("order", goal.order).field("accepted", answer.accepted);
            const Wanted wanted{client, 2, {7}};
            must_write(own.result.writer, &wanted);
        });
        take_all<Feedback>(
            own.feedback, [](const Feedback& told) { Line().field("feedback", told.numbers._length); });
        take_all<Result>(own.result.reader, [](const Result& result) {
            std::string numbers;
            for (uint32_t at = 0; at < result.numbers._length; ++at) {
                numbers += (at == 0 ? "" : ",") + std::to_string(result.numbers._buffer[at]);
            }
            Line().field("status", int(result.status)).put("result", "[" + numbers + "]");
        });
        return false;
    });
}

} // namespace

std::unique_ptr<Participant> join(const Arguments& arguments) {
    return std::make_unique<CycloneParticipant>(arguments);
}

int main(int count, char** words) {
    const Arguments arguments(count, words);
    Lifetime::bound(arguments.number("limit", 120));
    const std::string command = arguments.position(0, "a command; README.md lists them");
    if (command == "serve") {
        serve(arguments);
    } else if (command == "call") {
        call(arguments);
    } else if (command == "calls") {
        calls(arguments);
    } else if (command == "action-serve") {
        action_serve(arguments);
    } else if (command == "action-call") {
        action_call(arguments);
    } else if (!run_shared(command, arguments)) {
        Arguments::fail("there is no command " + command);
    }
    return 0;
}
