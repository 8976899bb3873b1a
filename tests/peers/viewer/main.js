// Starts the application of the package @foxglove/studio-base with one layout: the messages of the
// topic in the address of the page, the transforms in 3D, and the topics of the source.
const topic = new URLSearchParams(location.search).get("topic");
const data = {
  layout: { first: "RawMessages!1", second: "3D!1", direction: "row", splitPercentage: 40 },
  configById: {
    "RawMessages!1": { topicPath: topic, diffEnabled: false, expansion: "all" },
    "3D!1": { followTf: "world" },
  },
  globalVariables: {},
  userNodes: {},
  linkedGlobalVariables: [],
  playbackConfig: { speed: 1 },
};
const layout = {
  id: "judge",
  name: "judge",
  permission: "CREATOR_WRITE",
  baseline: { data, savedAt: new Date().toISOString() },
};
const layoutStorage = {
  list: async () => [layout],
  get: async () => layout,
  put: async (_namespace, changed) => changed,
  delete: async () => {},
  importLayouts: async () => {},
};
const appConfiguration = {
  get: (key) => ({ colorScheme: "light" })[key],
  set: async () => {},
  addChangeListener: () => {},
  removeChangeListener: () => {},
};
localStorage.setItem("studio.profile-data", JSON.stringify({ currentLayoutId: layout.id }));
initI18n().then(() => {
  const app = React.createElement(App, {
    deepLinks: [location.href],
    appConfiguration,
    dataSources: [new FoxgloveWebSocketDataSourceFactory()],
    layoutStorage,
    extensionLoaders: [],
    enableGlobalCss: true,
  });
  ReactDOM.render(app, document.getElementById("root"));
});
