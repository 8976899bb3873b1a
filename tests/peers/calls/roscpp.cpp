// A roscpp server and client of the cases in cases.py, without the headers that ROS would make of their definitions.
//
// `roscpp-peer serve CASE=/name ..` executes them; a line on standard input makes it tell what it executed.
// `roscpp-peer ask` takes the orders of ros1_asker.py, {"case": "bundled", "service": "/s", "first": 0, "count": 10}.
#include <algorithm>
#include <map>

#include <ros/ros.h>

#include "arguments.hpp"
#include "lines.hpp"

namespace {

struct Nothing {
    template <class Of, class Each> static void each(Of&, Each) {}
};

struct Done {
    uint8_t success = 0;
    std::string message;
    template <class Of, class Each> static void each(Of& of, Each each) {
        each(of.success);
        each(of.message);
    }
};

// A part of a service of a case, of which it is told apart from the other part and from those of other cases.
template <class Case> struct Request : Case::In {};
template <class Case> struct Response : Case::Out {};

struct Bundled {
    static constexpr const char* type = "std_srvs/SetBool";
    static constexpr const char* md5 = "09fb03525b03e7ea1fd3992bafd87e16";
    struct In {
        uint8_t data = 0;
        template <class Of, class Each> static void each(Of& of, Each each) { each(of.data); }
    };
    using Out = Done;
    static void ask(In& in, uint64_t number) { in.data = number % 2; }
    static uint64_t key(const In& in) { return in.data; }
    static void answer(const In& in, Out& out) {
        out.success = in.data;
        out.message = in.data ? "odd" : "even";
    }
    static bool right(const Out& out, uint64_t number) {
        return out.success == number % 2 && out.message == (number % 2 ? "odd" : "even");
    }
};

struct Files {
    static constexpr const char* type = "test_msgs/BasicTypes";
    static constexpr const char* md5 = "c6dfbb558aa399cd3af12dec345a3422";
    struct In {
        uint8_t bool_value = 0, byte_value = 0, char_value = 0;
        float float32_value = 0;
        double float64_value = 0;
        int8_t int8_value = 0;
        uint8_t uint8_value = 0;
        int16_t int16_value = 0;
        uint16_t uint16_value = 0;
        int32_t int32_value = 0;
        uint32_t uint32_value = 0;
        int64_t int64_value = 0;
        uint64_t uint64_value = 0;
        std::string string_value;
        template <class Of, class Each> static void each(Of& of, Each each) {
            each(of.bool_value), each(of.byte_value), each(of.char_value);
            each(of.float32_value), each(of.float64_value);
            each(of.int8_value), each(of.uint8_value), each(of.int16_value), each(of.uint16_value);
            each(of.int32_value), each(of.uint32_value), each(of.int64_value), each(of.uint64_value);
            each(of.string_value);
        }
    };
    using Out = In;
    static constexpr uint64_t first = 1ULL << 63;
    static void ask(In& in, uint64_t number) {
        in.bool_value = 1;
        in.float64_value = static_cast<double>(number) / 8;
        in.int16_value = static_cast<int16_t>(-static_cast<int>(number));
        in.uint64_value = first + number;
        in.string_value = "é " + std::to_string(number);
    }
    static uint64_t key(const In& in) { return in.uint64_value - first; }
    static void answer(const In& in, Out& out) {
        out.bool_value = !in.bool_value;
        out.float64_value = in.float64_value * 2;
        out.int16_value = in.int16_value;
        out.uint64_value = in.uint64_value;
        out.string_value = in.string_value + in.string_value;
    }
    static bool right(const Out& out, uint64_t number) {
        In in;
        ask(in, number);
        return !out.bool_value && out.float64_value == in.float64_value * 2 && out.int16_value == in.int16_value
            && out.uint64_value == in.uint64_value && out.string_value == in.string_value + in.string_value;
    }
};

struct Empty {
    static constexpr const char* type = "std_srvs/Trigger";
    static constexpr const char* md5 = "937c9679a518e3a18d831e57125ea522";
    using In = Nothing;
    using Out = Done;
    static void ask(In&, uint64_t) {}
    static uint64_t key(const In&) { return 0; }
    static void answer(const In&, Out& out) {
        out.success = 1;
        out.message = "done";
    }
    static bool right(const Out& out, uint64_t) { return out.success && out.message == "done"; }
};

struct Megabyte : Empty {
    static std::string text() {
        std::string text;
        for (int at = 0; at < 100'000; ++at) {
            text += "0123456789";
        }
        return text;
    }
    static void answer(const In&, Out& out) {
        out.success = 1;
        out.message = text();
    }
    static bool right(const Out& out, uint64_t) { return out.success && out.message == text(); }
};

struct State {
    uint8_t id = 0;
    std::string label;
    template <class Of, class Each> static void each(Of& of, Each each) {
        each(of.id);
        each(of.label);
    }
};

struct Messages : Empty {
    static constexpr const char* type = "lifecycle_msgs/GetAvailableStates";
    static constexpr const char* md5 = "035deb01560aba6ba016cae3a7e3584b";
    struct Out {
        std::vector<State> available_states;
        template <class Of, class Each> static void each(Of& of, Each each) { each(of.available_states); }
    };
    static constexpr const char* labels[] = {"one", "", "drei"};
    static void answer(const In&, Out& out) {
        for (uint8_t id = 0; id < 3; ++id) {
            out.available_states.emplace_back();
            out.available_states.back().id = id;
            out.available_states.back().label = labels[id];
        }
    }
    static bool right(const Out& out, uint64_t) {
        const auto& states = out.available_states;
        if (states.size() != 3) {
            return false;
        }
        uint8_t id = 0;
        return std::all_of(states.begin(), states.end(), [&id](const State& state) {
            const bool right = state.id == id && state.label == labels[id];
            ++id;
            return right;
        });
    }
};

// Methods of a component's skill: done, or refused in its own words, as its state or somebody's lease demands.
bool allowed(bool success, const std::string& message) {
    return success || message.rfind("BadInvalidState", 0) == 0 || message.rfind("BadLocked", 0) == 0;
}

struct Skill : Empty {
    static bool right(const Out& out, uint64_t) { return allowed(out.success, out.message); }
};

struct Grasp : Files {
    static void ask(In& in, uint64_t number) { in.float64_value = 10.0 + static_cast<double>(number); }
    static bool right(const Out& out, uint64_t) { return allowed(out.bool_value, out.string_value); }
};

}  // namespace

namespace ros::serialization {
#define FIELDS_OF(TYPE)                                                                                   \
    {                                                                                                     \
        template <typename Stream, typename T> inline static void allInOne(Stream& stream, T of) {        \
            std::remove_reference_t<T>::each(of, [&stream](auto& field) { stream.next(field); });         \
        }                                                                                                 \
        ROS_DECLARE_ALLINONE_SERIALIZER                                                                   \
    }
template <class Case> struct Serializer<Request<Case>> FIELDS_OF(Request<Case>);
template <class Case> struct Serializer<Response<Case>> FIELDS_OF(Response<Case>);
template <> struct Serializer<State> FIELDS_OF(State);
}  // namespace ros::serialization

namespace ros::service_traits {
#define TRAIT(TRAIT, PART, VALUE)                                                                         \
    template <class Case> struct TRAIT<PART<Case>> {                                                      \
        static const char* value() { return VALUE; }                                                      \
        static const char* value(const PART<Case>&) { return VALUE; }                                     \
    };
TRAIT(MD5Sum, Request, Case::md5)
TRAIT(MD5Sum, Response, Case::md5)
TRAIT(DataType, Request, Case::type)
TRAIT(DataType, Response, Case::type)
}  // namespace ros::service_traits

namespace ros::message_traits {
TRAIT(DataType, Request, Case::type)
TRAIT(DataType, Response, Case::type)
}  // namespace ros::message_traits

namespace {

// The value of a key in an order, which holds no objects.
std::string value(const std::string& order, const std::string& key, const std::string& otherwise) {
    const std::string wanted = "\"" + key + "\":";
    size_t at = order.find(wanted);
    if (at == std::string::npos) {
        return otherwise;
    }
    at = order.find_first_not_of(' ', at + wanted.size());
    return order[at] == '"' ? order.substr(at + 1, order.find('"', at + 1) - at - 1)
                            : order.substr(at, order.find_first_of(",}", at) - at);
}

template <class Case> std::string asked(const std::string& order) {
    const std::string service = value(order, "service", "");
    const double wait = std::stod(value(order, "wait", "20"));
    if (!ros::service::waitForService(service, ros::Duration(wait))) {
        return "{\"absent\":true}";
    }
    const uint64_t first = std::stoull(value(order, "first", "0"));
    const uint64_t count = std::stoull(value(order, "count", "1"));
    uint64_t right = 0, wrongs = 0, failures = 0;
    ros::NodeHandle node;
    for (uint64_t number = first; number < first + count; ++number) {
        ros::ServiceClient client = node.serviceClient<Request<Case>, Response<Case>>(service);
        Request<Case> request;
        Response<Case> response;
        Case::ask(request, number);
        if (!client.call(request, response)) {
            ++failures;
        } else {
            ++(Case::right(response, number) ? right : wrongs);
        }
    }
    return "{\"right\":" + std::to_string(right) + ",\"wrongs\":" + std::to_string(wrongs)
        + ",\"failures\":" + std::to_string(failures) + "}";
}

class Counted {
public:
    template <class Case> ros::ServiceServer serve(ros::NodeHandle& node, const std::string& name) {
        const boost::function<bool(Request<Case>&, Response<Case>&)> execute = [this](auto& request, auto& response) {
            const std::lock_guard<std::mutex> guard(lock_);
            ++times_[{Case::type, Case::key(request)}];
            Case::answer(request, response);
            return true;
        };
        return node.advertiseService(name, execute);
    }

    void tell() {
        const std::lock_guard<std::mutex> guard(lock_);
        uint64_t executed = 0;
        for (const auto& [key, times] : times_) {
            executed += times;
        }
        Line().field("executed", executed).field("different", times_.size()).field("running", 0);
    }

private:
    std::mutex lock_;
    std::map<std::pair<std::string, uint64_t>, uint64_t> times_;
};

// Calls `with` for the case of that name, as a value of its type.
template <class With> auto by_name(const std::string& name, With with) {
    if (name == "bundled") {
        return with(Bundled());
    }
    if (name == "files") {
        return with(Files());
    }
    if (name == "empty") {
        return with(Empty());
    }
    if (name == "megabyte") {
        return with(Megabyte());
    }
    if (name == "skill") {
        return with(Skill());
    }
    if (name == "grasp") {
        return with(Grasp());
    }
    if (name != "messages") {
        Arguments::fail("no case " + name);
    }
    return with(Messages());
}

}  // namespace

int main(int count, char** words) {
    const Arguments arguments(count, words);
    const std::string role = arguments.position(0, "serve or ask");
    ros::init(ros::M_string(), "roscpp_" + role, ros::init_options::NoSigintHandler | ros::init_options::NoRosout);
    Lifetime::bound(arguments.number("limit", 200));
    ros::NodeHandle node;
    ros::AsyncSpinner spinner(4);
    spinner.start();
    if (role == "ask") {
        Line().field("ready", role);
        while (const auto order = Lifetime::line()) {
            const std::string told = by_name(value(*order, "case", ""), [&order](auto of) {
                return asked<decltype(of)>(*order);
            });
            Line().put("id", value(*order, "id", "null")).put("answer", told);
        }
        return 0;
    }
    Counted counted;
    std::vector<ros::ServiceServer> servers;
    for (int at = 2; at < count && std::string(words[at]).rfind("--", 0) != 0; ++at) {
        const std::string word = words[at];
        const size_t sign = word.find('=');
        servers.push_back(by_name(word.substr(0, sign), [&](auto of) {
            return counted.serve<decltype(of)>(node, word.substr(sign + 1));
        }));
    }
    Line().field("ready", role);
    while (Lifetime::line()) {
        counted.tell();
    }
    return 0;
}
