// The Fast DDS peer: services, and the commands both makers' peers have.
#include "fastdds.hpp"
#include "fastdds_action.hpp"

namespace {

std::string text(const rtps::GUID_t& guid) {
    Body bytes(guid.guidPrefix.value, guid.guidPrefix.value + 12);
    bytes.insert(bytes.end(), guid.entityId.value, guid.entityId.value + 4);
    return hex(bytes);
}

Service service_of(const Arguments& arguments) {
    return Service(arguments.position(1, "a service"), "srv", arguments.position(2, "a type"));
}

// A service server. It answers with the next of --hex, or with the request itself where there is none.
void serve(const Arguments& arguments) {
    const Service service = service_of(arguments);
    const Quality quality;
    std::vector<Body> replies;
    for (const auto& digits : arguments.all("hex")) {
        replies.push_back(of_hex(digits));
    }
    FastParticipant participant(arguments);
    const auto writer = participant.writer(service.reply, service.reply_type, quality);
    auto& replier = static_cast<FastWriter&>(*writer);
    size_t served = 0;
    const auto reader = participant.informed(
        service.request, service.request_type, quality, [&](const Body& request, const fast::SampleInfo& info) {
            const rtps::SampleIdentity identity = client_of(info);
            const Body& reply = replies.empty() ? request : replies[served % replies.size()];
            ++served;
            const bool taken = replier.reply(identity, reply);
            Line line;
            line.field("request", hex(request)).field("seq", info.sample_identity.sequence_number().to64long());
            line.field("client", text(identity.writer_guid())).field("replied", taken);
        });
    Line().field("ready", arguments.position(1, "a service"));
    Lifetime::wait_until_told();
}

// A service client: one request of --hex after the other, each awaited.
void call(const Arguments& arguments) {
    const Service service = service_of(arguments);
    const Quality quality;
    std::mutex heard;
    std::condition_variable came;
    std::map<int64_t, Body> replies;
    std::atomic<uint64_t> of_others = 0;
    FastParticipant participant(arguments);
    const auto writer = participant.writer(service.request, service.request_type, quality);
    auto& requester = static_cast<FastWriter&>(*writer);
    rtps::GUID_t own;
    const auto reader = participant.informed(
        service.reply, service.reply_type, quality, [&](const Body& reply, const fast::SampleInfo& info) {
            const std::lock_guard<std::mutex> guard(heard);
            const auto& identity = info.related_sample_identity;
            if (identity.writer_guid() != own && identity.writer_guid() != requester.guid()) {
                ++of_others;
                return;
            }
            replies[identity.sequence_number().to64long()] = reply;
            came.notify_all();
        });
    {
        const std::lock_guard<std::mutex> guard(heard);
        own = reader->guid();
    }
    Line().field("ready", arguments.position(1, "a service"));
    while (requester.readers() < 1 || reader->writers() < 1) {
        std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
    Line().field("matched", true);
    const auto& requests = arguments.all("hex");
    const auto count = static_cast<size_t>(arguments.number("count", static_cast<double>(requests.size())));
    const auto patience = std::chrono::duration<double>(arguments.number("patience", 10));
    for (size_t turn = 0; turn < count && !requests.empty() && !Lifetime::told(); ++turn) {
        rtps::WriteParams params;
        params.related_sample_identity().writer_guid() = own;
        const auto start = std::chrono::steady_clock::now();
        if (!requester.write(of_hex(requests[turn % requests.size()]), params)) {
            Line().field("refused", turn);
            continue;
        }
        const int64_t sequence = params.sample_identity().sequence_number().to64long();
        std::unique_lock<std::mutex> guard(heard);
        const bool answered = came.wait_for(guard, patience, [&] { return replies.count(sequence) > 0; });
        const double took = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
        Line line;
        line.field("seq", sequence).field("seconds", took);
        if (answered) {
            line.field("reply", hex(replies[sequence]));
        } else {
            line.put("reply", "null");
        }
    }
    Line().field("done", true).field("of_others", of_others.load());
    Lifetime::wait_until_told();
}

} // namespace

std::unique_ptr<Participant> join(const Arguments& arguments) {
    return std::make_unique<FastParticipant>(arguments);
}

int main(int count, char** words) {
    const Arguments arguments(count, words);
    Lifetime::bound(arguments.number("limit", 120));
    const std::string command = arguments.position(0, "a command; README.md lists them");
    if (command == "serve") {
        serve(arguments);
    } else if (command == "call") {
        call(arguments);
    } else if (command == "action-serve") {
        action_serve(arguments);
    } else if (command == "action-call") {
        action_call(arguments);
    } else if (!run_shared(command, arguments)) {
        Arguments::fail("there is no command " + command);
    }
    return 0;
}
