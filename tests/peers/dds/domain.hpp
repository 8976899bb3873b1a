// What the peers of both makers do, for the commands they share. Each maker's file implements it.
#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "body.hpp"

struct Quality {
    bool reliable = true;
    bool transient_local = false;
    int depth = 100;
    // Whole seconds between HEARTBEATs. Cyclone DDS lets nobody choose.
    std::optional<int32_t> heartbeat_period;

    static Quality from(const Arguments& arguments) {
        Quality quality;
        quality.reliable = arguments.text("reliability", "reliable") == "reliable";
        quality.transient_local = arguments.text("durability", "volatile") == "transient_local";
        quality.depth = static_cast<int>(arguments.number("depth", quality.depth));
        if (arguments.has("heartbeat-period")) {
            quality.heartbeat_period = static_cast<int32_t>(arguments.number("heartbeat-period", 0));
        }
        return quality;
    }
};

struct Sample {
    const Body& body;
    // Unix time in ns the writer gave it.
    int64_t source;
};

class Writer {
public:
    virtual ~Writer() = default;
    // False when it was not taken within the time reliable writers wait for room.
    virtual bool write(const Body& body) = 0;
    virtual int readers() = 0;
    // Whether all readers have all samples within that time.
    virtual bool acknowledged(double seconds) = 0;
};

class Reader {
public:
    virtual ~Reader() = default;
    virtual int writers() = 0;
};

class Participant {
public:
    virtual ~Participant() = default;
    virtual std::unique_ptr<Writer> writer(const std::string& topic, const std::string& type, const Quality&) = 0;
    // `heard` is called by a thread of the middleware; the body is the reader's until it returns.
    virtual std::unique_ptr<Reader> reader(const std::string& topic, const std::string& type, const Quality&,
                                           std::function<void(const Sample&)> heard)
        = 0;
};

// Each call makes one more participant, of the domain and on the interface the arguments say.
std::unique_ptr<Participant> join(const Arguments& arguments);

// `/chatter` as ROS 2 names it on DDS.
inline std::string dds_topic(const std::string& prefix, const std::string& name, const std::string& suffix = "") {
    return prefix + (name.rfind('/', 0) == 0 ? name : "/" + name) + suffix;
}

// `std_msgs/String` and `std_msgs/msg/String` as ROS 2 names them on DDS; `kind` is msg, srv or action.
inline std::string dds_type(const std::string& kind, const std::string& name, const std::string& suffix = "") {
    const auto first = name.find('/');
    const auto last = name.rfind('/');
    if (first == std::string::npos) {
        Arguments::fail("a type is package/Name, not " + name);
    }
    return name.substr(0, first) + "::" + kind + "::dds_::" + name.substr(last + 1) + suffix + "_";
}

// Runs pub, sub, relay or crowd; false when `command` is none of them.
bool run_shared(const std::string& command, const Arguments& arguments);

// Runs ping, pace or meter; false when `command` is none of them.
bool run_measuring(const std::string& command, const Arguments& arguments);
